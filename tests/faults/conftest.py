"""Fixtures of the fault tests: the number of cases, and the table of counts."""

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from .disk import Disk

Count = Callable[..., None]
ROW = "faults"
COLUMNS = ("cases", "refused in one line", "right", "found by a second run")
MARKS = ("<!-- faults: begin -->", "<!-- faults: end -->")
SHARE = float(os.environ.get("DMRL_FAULTS", "1"))
"""Share of the cases that the slow tests try. 0.1 is enough for a slow machine."""
SEED = int(os.environ.get("DMRL_FAULTS_SEED", "2"))
"""Seed of the mutated recordings. Another seed tries other mutations."""


def scale_cases(most: int) -> int:
    """Return the number of cases to try, of ``most`` in a full run."""
    return max(1, round(SHARE * most))


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Disk]:
    """Return a disk that fails on demand, with the process that runs commands on it."""
    disk = Disk(tmp_path_factory.mktemp("disk"))
    yield disk
    disk.close()


@pytest.fixture
def count(request: pytest.FixtureRequest) -> Count:
    """Return a function that adds to a row of the table: ``count("row", cases=1, refused=1)``."""

    def add(row: str, **counts: int) -> None:
        request.node.user_properties.append((ROW, [row, counts]))

    return add


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the table of counts, and write it into the page that ``DMRL_FAULTS_PAGE`` names."""
    rows: dict[str, Counter[str]] = {}
    for report in terminalreporter.getreports("passed"):
        for name, value in report.user_properties:
            if name == ROW:
                rows.setdefault(value[0], Counter()).update(value[1])
    if not rows:
        return
    terminalreporter.write_sep("-", "faults, and their outcome")
    terminalreporter.write_line(format_table(rows))
    sys.stdout.flush()
    if page := os.environ.get("DMRL_FAULTS_PAGE"):
        failed = len(terminalreporter.getreports("failed"))
        write_table(Path(page), format_table(join_commands(rows)), failed)


def join_commands(rows: dict[str, Counter[str]]) -> dict[str, Counter[str]]:
    """Sum the rows ``KIND: COMMAND`` of one kind of fault, and list the commands in its name."""
    kinds: dict[str, Counter[str]] = {}
    commands: dict[str, list[str]] = {}
    for row, counts in sorted(rows.items()):
        kind, _, command = row.partition(": ")
        kinds.setdefault(kind, Counter()).update(counts)
        commands.setdefault(kind, []).append(f"`{command}`")
    return {
        f"{kind}: {', '.join(commands[kind])}" if commands[kind] != ["``"] else kind: counts
        for kind, counts in kinds.items()
    }


def format_table(rows: dict[str, Counter[str]]) -> str:
    """Return the counts as a table of Markdown."""
    lines = [f"| fault | {' | '.join(COLUMNS)} |", f"|---|{'--:|' * len(COLUMNS)}"]
    for row, counts in sorted(rows.items()):
        cells = (str(counts[key]) if (key := c.split()[0]) in counts else "" for c in COLUMNS)
        lines.append(f"| {row} | {' | '.join(cells)} |")
    return "\n".join(lines)


def write_table(page: Path, table: str, failed: int) -> None:
    """Replace the table between the marks of a page; note the command and version above it."""
    git = ["git", "rev-parse", "--short", "HEAD"]
    version = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    note = (
        f"`DMRL_FAULTS={SHARE:g} DMRL_FAULTS_SEED={SEED} make reliability` at {version} on "
        f"{datetime.now(UTC).date()}; tests that failed: {failed}."
    )
    before, rest = page.read_text(encoding="utf-8").split(MARKS[0])
    after = rest.split(MARKS[1])[1]
    text = f"{before}{MARKS[0]}\n\n{note}\n\n{table}\n\n{MARKS[1]}{after}"
    page.write_text(text, encoding="utf-8")
