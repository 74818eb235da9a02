"""Who is linked to, and whose ranges are recorded."""

import pytest

from dmrl.live.links import build_links
from dmrl.live.queue import SampleQueue
from dmrl.live.receive_clocks import HostClock
from dmrl.live.robot_options import RobotOptions


@pytest.mark.parametrize(
    ("names", "peer", "said"),
    [
        (["left", "right"], [], ["left: the peer of", "right: the peer of"]),
        (["left", "right"], ["1=left", "2=right"], []),
        (["cf1", "cf2"], [], []),
        (["left"], [], []),
    ],
)
def test_ranges_without_a_known_peer_are_reported(
    names: list[str], peer: list[str], said: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    robots = [
        RobotOptions(name, f"udp://127.0.0.1:{k}", None, None)
        for k, name in enumerate(names, 19850)
    ]
    links = build_links(robots, peer, 100.0, SampleQueue(), HostClock())
    assert list(links) == names
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "the peer of" in line] == lines
    assert [line[: len(start)] for line, start in zip(lines, said, strict=True)] == said
