"""Damaged third-party files give a result or a one-line error, and change no other file."""

from pathlib import Path

import pytest

from .conftest import Count, scale_cases
from .damaged_files import SOURCES
from .disk import Disk

CASES_PER_PROCESS = 25
"""Cases that one process tries before a new one starts."""
MEMORY_KB = 1_500_000
"""Memory limit of a process, including torch."""
QUICK = ("labels of pictures", "a recipe of a pipeline")


def check_damaged_source(name: str, disk: Disk, folder: Path, cases: int, count: Count) -> None:
    """Damage and use a source in this many cases; assert that no other file changes."""
    victim = folder / "victim"
    victim.write_text("precious")
    (folder / "out").mkdir()
    assert disk.call("damaged_files:use_sound_source", name=name, folder=str(folder)) == 0
    before = {path for path in folder.rglob("*") if "out" not in path.parts}
    refused = 0
    for seed in range(-(-cases // CASES_PER_PROCESS)):
        some = min(CASES_PER_PROCESS, cases - seed * CASES_PER_PROCESS)
        refused += disk.call(
            "damaged_files:use_damaged_sources",
            name=name,
            folder=str(folder),
            seed=seed,
            cases=some,
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
    check_damaged_source(name, disk, tmp_path, 10, count)


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("name", SOURCES)
def test_damaged_files_of_every_kind_are_refused_or_used(
    name: str, disk: Disk, tmp_path: Path, count: Count
) -> None:
    check_damaged_source(name, disk, tmp_path, scale_cases(1000), count)
