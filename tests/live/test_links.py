"""Who is linked to, and whose ranges are recorded."""

import pytest

from dmrl.live.links import links_of
from dmrl.live.queue import Feed
from dmrl.live.receive_clocks import HostTime
from dmrl.live.robot_options import Robot


@pytest.mark.parametrize(
    ("names", "peer", "said"),
    [
        (["left", "right"], [], ["left: the peer of", "right: the peer of"]),
        (["left", "right"], ["1=left", "2=right"], []),
        (["cf1", "cf2"], [], []),
        (["left"], [], []),
    ],
)
def test_ranges_that_are_nobodys_are_said(
    names: list[str], peer: list[str], said: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    robots = [
        Robot(name, f"udp://127.0.0.1:{k}", None, None) for k, name in enumerate(names, 19850)
    ]
    links = links_of(robots, peer, 100.0, Feed(), HostTime())
    assert list(links) == names
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if "the peer of" in line] == lines
    assert [line[: len(start)] for line, start in zip(lines, said, strict=True)] == said
