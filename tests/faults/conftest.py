"""What the tests of faults share: how many cases are tried, and the table of counts."""

import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from .disk import Disk

Count = Callable[..., None]
ROW = "faults"
SHARE = float(os.environ.get("DMRL_FAULTS", "1"))
"""Of the cases that the slow tests try. 0.1 on a machine that has little time."""
SEED = int(os.environ.get("DMRL_FAULTS_SEED", "2"))
"""Of the mutated recordings: another one tries others."""


def cases_of(most: int) -> int:
    """How many of them are tried."""
    return max(1, round(SHARE * most))


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Disk]:
    """A disk that fails, and a process that has loaded what is run on it."""
    disk = Disk(tmp_path_factory.mktemp("disk"))
    yield disk
    disk.close()


@pytest.fixture
def count(request: pytest.FixtureRequest) -> Count:
    """Adds to a row of the table: ``count("row", cases=1, refused=1)``."""

    def add(row: str, **counts: int) -> None:
        request.node.user_properties.append((ROW, [row, counts]))

    return add


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The table of counts."""
    rows: dict[str, Counter[str]] = {}
    for report in terminalreporter.getreports("passed"):
        for name, value in report.user_properties:
            if name == ROW:
                rows.setdefault(value[0], Counter()).update(value[1])
    if not rows:
        return
    columns = ("cases", "refused in one line", "right", "found by a second run")
    terminalreporter.write_sep("-", "what was broken, how often, and what came of it")
    terminalreporter.write_line(f"| what | {' | '.join(columns)} |")
    terminalreporter.write_line(f"|---|{'--:|' * len(columns)}")
    for row, counts in sorted(rows.items()):
        cells = " | ".join(
            str(counts[c.split()[0]]) if c.split()[0] in counts else "" for c in columns
        )
        terminalreporter.write_line(f"| {row} | {cells} |")
    sys.stdout.flush()
