"""Number of times that a command opens its input, counted by an audit hook."""

import os
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from dmrl.stages import dataset, label

OPENED: Counter[str] = Counter()


def _count_open(event: str, arguments: tuple[Any, ...]) -> None:
    """Count the opening of a file by its path."""
    if event == "open" and isinstance(arguments[0], str | os.PathLike):
        OPENED[os.fspath(arguments[0])] += 1


sys.addaudithook(_count_open)  # sees every way to open a file, and cannot be removed


@pytest.mark.heavy
def test_label_opens_its_input_three_times(flight: Path, tmp_path: Path) -> None:
    before = OPENED[str(flight)]
    label.run(flight, tmp_path / "out.mcap", label.Settings(method="ekf"))
    assert OPENED[str(flight)] - before <= 3


@pytest.mark.heavy
def test_dataset_opens_its_input_three_times(flight: Path, tmp_path: Path) -> None:
    before = OPENED[str(flight)]
    dataset.run([flight], tmp_path / "out", dataset.Settings())
    assert OPENED[str(flight)] - before <= 3
