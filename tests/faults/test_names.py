"""Hostile output names for every command that writes: an output, or one line and no output."""

from pathlib import Path

import pytest

from .conftest import Count
from .disk import Disk
from .workloads import WORKLOADS, Workload, clear

NAMES = ("\udcff", "\udcffof/x", "a\n$(touch b)", "-rf", "x" * 300, "a\0b", "of/none/x", "loop")
"""Of what is no text, a terminal's and a shell's orders, too long, and where nothing can be."""


def others(folder: Path) -> None:
    """What stands beside the outputs."""
    clear(folder)
    for name in ("of", "\udcffof"):
        (folder / name).mkdir()
    (folder / "loop").symlink_to("loop")


def below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


@pytest.mark.heavy
@pytest.mark.parametrize("work", WORKLOADS, ids=lambda work: work.name)
def test_a_hostile_name_is_taken_or_refused_in_one_line(
    work: Workload, disk: Disk, tmp_path: Path, count: Count
) -> None:
    made = 0
    for name in NAMES:
        others(folder := tmp_path / "disk")
        out = folder / (name + Path(work.out).suffix)
        if work.before and "fault" in disk.ask("server:prepare_work", work=work.name, out=str(out)):
            continue  # nothing can be there, so nothing can be added to it
        before = below(folder)
        given = {"work": work.name, "out": str(out), "most_bytes": None}
        status, said = disk.call("server:run_work", **given)
        assert status in (0, 1), said
        assert status == 0 or below(folder) == before, (name, said, below(folder) - before)
        new = [folder / one for one in below(folder) - before]
        assert all(one.is_relative_to(out) or out.is_relative_to(one) for one in new)
        made += status == 0
    assert made >= 2
    count("hostile names of outputs", cases=len(NAMES), refused=len(NAMES) - made, right=made)
