"""Links to robots and cameras, and the peers of recorded ranges."""

from dataclasses import replace
from pathlib import Path

import pytest

from dmrl.geometry.camera_file import format_camera
from dmrl.geometry.frames import AIDECK
from dmrl.live.links import build_cameras, build_links
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


@pytest.mark.parametrize("mounted", [False, True])
def test_a_mount_that_a_recording_does_not_hold_is_named(
    mounted: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "camera.toml"
    file.write_text(format_camera(replace(AIDECK, delay_s=0.03) if mounted else AIDECK))
    robots = [RobotOptions("cf1", "udp://127.0.0.1:19850", ("127.0.0.1", 5000), file)]
    links = build_links(robots, [], 100.0, SampleQueue(), HostClock())
    build_cameras(robots, links, ("colour", "png"), SampleQueue(), HostClock())
    assert ("dmrl label, too: --camera.cf1 FILE" in capsys.readouterr().err) == mounted
