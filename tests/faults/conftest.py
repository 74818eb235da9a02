"""What the tests of faults share: inputs, one command run to its end, and the table of counts."""

import io
import os
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from typing import Any

import pytest

from dmrl.boundary import status_of

from .works import Inputs, contents, prepare

Count = Callable[..., None]
ROW = "faults"
SHARE = float(os.environ.get("DMRL_FAULTS", "1"))
"""Of the cases that the slow tests try. 0.1 on a machine that has little time."""


def cases_of(most: int) -> int:
    """How many of them are tried."""
    return max(1, round(SHARE * most))


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """Inputs of every stage; whole and unchanged at the end."""
    return prepare(tmp_path_factory.mktemp("inputs"))


@pytest.fixture
def count(request: pytest.FixtureRequest) -> Count:
    """Adds to a row of the table: ``count("row", cases=1, refused=1)``."""

    def add(row: str, **counts: int) -> None:
        request.node.user_properties.append((ROW, [row, counts]))

    return add


def ended(work: Callable[[], object]) -> tuple[int, str]:
    """Exit status and last words of a command; never a bug, never more than one line of error."""
    said = io.StringIO()
    with redirect_stderr(said), redirect_stdout(io.StringIO()):
        status = status_of(work)
    errors = [line for line in said.getvalue().splitlines() if line.startswith("dmrl: ")]
    text = errors[-1] if errors else ""
    assert "Traceback" not in said.getvalue(), said.getvalue()
    assert "internal error" not in text, text
    assert len(errors) == (1 if status else 0), said.getvalue()
    return status, text


def unchanged(inputs: Inputs, before: dict[str, bytes]) -> None:
    """Nothing, if the inputs are what they were."""
    assert contents(inputs.folder) == before


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The table of counts."""
    rows: dict[str, Counter[str]] = {}
    for report in terminalreporter.getreports("passed"):
        for name, value in report.user_properties:
            if name == ROW:
                rows.setdefault(value[0], Counter()).update(value[1])
    if not rows:
        return
    columns = ("cases", "refused in one line", "right", "found again")
    terminalreporter.write_sep("-", "what was broken, how often, and what came of it")
    terminalreporter.write_line(f"| what | {' | '.join(columns)} |")
    terminalreporter.write_line(f"|---|{'--:|' * len(columns)}")
    for row, counts in sorted(rows.items()):
        cells = " | ".join(
            str(counts[c.split()[0]]) if c.split()[0] in counts else "" for c in columns
        )
        terminalreporter.write_line(f"| {row} | {cells} |")
    sys.stdout.flush()
