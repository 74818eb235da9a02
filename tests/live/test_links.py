"""Who is linked to, and whose ranges are recorded."""

import pytest

from dmrl.live.links import build_links
from dmrl.live.log_blocks import plan_blocks
from dmrl.live.queue import SampleQueue
from dmrl.live.receive_clocks import HostClock
from dmrl.live.robot_options import RobotOptions

TOC = {f"stateEstimate.{name}": "float" for name in ("roll", "pitch", "yaw", "vx", "vy", "z")} | {
    "gyro.z": "float",
    "ranging.distance1": "float",
    "ranging.distance2": "float",
}
UNNAMED = "ranging.distance1, ranging.distance2 not recorded"


@pytest.mark.parametrize(
    ("names", "peer", "said"),
    [
        (["left", "right"], [], UNNAMED),
        (["left", "right"], ["1=left", "2=right"], ""),
        (["cf1", "cf2"], [], ""),
        (["cf1"], [], UNNAMED),
        (["cf1"], ["2=cf2"], ""),
        (["cf1"], ["3=cf3"], "cf1 logs no distance to cf3"),
    ],
)
def test_ranges_without_a_known_peer_are_reported(
    names: list[str], peer: list[str], said: str
) -> None:
    robots = [
        RobotOptions(name, f"udp://127.0.0.1:{k}", None, None)
        for k, name in enumerate(names, 19850)
    ]
    feed = SampleQueue()
    links = build_links(robots, peer, 100.0, feed, HostClock())
    assert list(links) == names
    link = links[names[0]]
    link._report_missing(TOC, plan_blocks(TOC, link._peers, 10))
    lines = feed.get_batch(0.0)
    assert [said in str(line) for line in lines] == [True] * bool(said)
    link.health.connections = 1
    link._report_missing(TOC, plan_blocks(TOC, link._peers, 10))
    assert feed.get_batch(0.0) == []
