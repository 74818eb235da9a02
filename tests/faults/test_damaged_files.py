"""Damaged or hostile third-party files: one line or a result, and nothing outside OUT."""

from pathlib import Path

import pytest

from .conftest import Count, cases_of
from .damaged_files import SOURCES
from .disk import Disk

AT_ONCE = 25
"""Cases that a process goes through before a fresh one."""
MEMORY_KB = 1_500_000
"""What a process may take, torch and all."""
QUICK = ("labels of pictures", "a recipe of a pipeline")


def damaged(name: str, disk: Disk, folder: Path, cases: int, count: Count) -> None:
    """Damage one file of a source again and again, and use it."""
    victim = folder / "victim"
    victim.write_text("precious")
    (folder / "out").mkdir()
    assert disk.call("damaged_files:begin", name=name, folder=str(folder)) == 0
    before = {path for path in folder.rglob("*") if "out" not in path.parts}
    refused = 0
    for seed in range(-(-cases // AT_ONCE)):
        some = min(AT_ONCE, cases - seed * AT_ONCE)
        refused += disk.call(
            "damaged_files:damage", name=name, folder=str(folder), seed=seed, cases=some
        )
        assert disk.rss_kb < MEMORY_KB, f"seed {seed}: {disk.rss_kb / 1e6:.1f} GB"
    assert victim.read_text() == "precious"
    assert {path for path in folder.rglob("*") if "out" not in path.parts} == before
    count(f"damaged: {name}", cases=cases, refused=refused, right=cases - refused)


@pytest.mark.heavy
@pytest.mark.parametrize("name", QUICK)
def test_damaged_files_are_refused_or_read(
    name: str, disk: Disk, tmp_path: Path, count: Count
) -> None:
    damaged(name, disk, tmp_path, 10, count)


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("name", SOURCES)
def test_damaged_files_of_every_kind_are_refused_or_used(
    name: str, disk: Disk, tmp_path: Path, count: Count
) -> None:
    damaged(name, disk, tmp_path, cases_of(1000), count)
