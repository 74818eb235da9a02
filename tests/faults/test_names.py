"""Hostile output names give an output, or a one-line error and no output."""

from pathlib import Path

import pytest

from .conftest import Count
from .disk import Disk
from .workloads import WORKLOADS, Workload, clear_folder

NAMES = ("\udcff", "\udcffof/x", "a\n$(touch b)", "-rf", "x" * 300, "a\0b", "of/none/x", "loop")
"""Names that are not UTF-8, shell code, a flag, too long, with a zero byte, or unreachable."""


def make_neighbours(folder: Path) -> None:
    """Make the folders and the symbolic link that some of the names lead into."""
    clear_folder(folder)
    for name in ("of", "\udcffof"):
        (folder / name).mkdir()
    (folder / "loop").symlink_to("loop")


def list_files(folder: Path) -> set[str]:
    """Return the relative paths of everything below a folder."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


@pytest.mark.heavy
@pytest.mark.parametrize("work", WORKLOADS, ids=lambda work: work.name)
def test_a_hostile_name_is_taken_or_refused_in_one_line(
    work: Workload, disk: Disk, tmp_path: Path, count: Count
) -> None:
    made = 0
    for name in NAMES:
        make_neighbours(folder := tmp_path / "disk")
        out = folder / (name + Path(work.out).suffix)
        if work.before and "fault" in disk.ask("server:prepare_work", work=work.name, out=str(out)):
            continue  # no dataset can exist there, so the command cannot append to one
        before = list_files(folder)
        given = {"work": work.name, "out": str(out), "most_bytes": None}
        status, said = disk.call("server:run_work", **given)
        assert status in (0, 1), said
        assert status == 0 or list_files(folder) == before, (
            name,
            said,
            list_files(folder) - before,
        )
        new = [folder / one for one in list_files(folder) - before]
        assert all(one.is_relative_to(out) or out.is_relative_to(one) for one in new)
        made += status == 0
    assert made >= 2
    count("hostile names of outputs", cases=len(NAMES), refused=len(NAMES) - made, right=made)
