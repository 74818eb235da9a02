"""After a power failure at any moment, outputs are complete or absent, extended ones old or new.

Only data that were synced count as written; see `power_loss`. strace records the system calls of
the command and of its libraries.
"""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from dmrl.datasets import open_dataset

from .inputs import Inputs, cli, copy_flights
from .power_loss import Recorded
from .workloads import read_contents

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not shutil.which("strace"), reason="strace is not installed (apt-get)"),
]
OUTPUTS = {
    "trim": ("trim {dots} {out}/a.mcap --to-s 0.9", "a.mcap"),
    "sketch": ("sketch {out}/a --images 2", "a"),
    "convert to csv": ("convert {moment} {out}/a --to csv", "a"),
    "dataset": ("dataset {dots} {out}/a", "a"),
    "export": ("export {int8} {out}/a", "a"),
    "quantize": ("quantize {model} {set} {out}/a", "a"),
    "train": ("train {set} {out}/a --recipe {short} --device cpu", "a"),
    "index": ("index {out}/a --workers 1", "a/catalogue.parquet"),
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    return Inputs(tmp_path_factory.mktemp("inputs"))


def record_command(words: str, inputs: Inputs, disk: Path, log: Path) -> Recorded:
    """Run a command that writes below a folder, and return its recorded calls."""
    known = ("dots", "moment", "int8", "model", "set", "short", "more", "chain")
    places = {name: getattr(inputs, name) for name in known if f"{{{name}}}" in words}
    filled = [word.format(out=disk, **places) for word in words.split()]
    recorded = Recorded(disk)
    recorded.run([sys.executable, "-m", "dmrl", *filled], log)
    return recorded


def check_survivors(
    recorded: Recorded, into: Path, states: list[object], read: Callable[[Path], object]
) -> int:
    """Assert that every survivor is in one of the states, and the last ones in the last state.

    Return the number of survivors.
    """
    into.mkdir()
    count = 0
    for moment, place in recorded.survivors(into):
        allowed = states[-1:] if moment.startswith(f"{recorded.moment} of ") else states
        assert read(place) in allowed, moment
        shutil.rmtree(place)
        count += 1
    return count


def read_output(path: Path) -> object:
    """Return the content of an output, or None if it does not exist."""
    return read_contents(path) if path.exists() else None


@pytest.mark.parametrize("work", OUTPUTS)
def test_output_is_complete_or_absent_after_power_loss(
    work: str, inputs: Inputs, tmp_path: Path
) -> None:
    words, name = OUTPUTS[work]
    disk = tmp_path / "disk"
    disk.mkdir()
    if work == "index":
        copy_flights(inputs, disk / "a")
    recorded = record_command(words, inputs, disk, tmp_path / "log")
    whole = read_output(disk / name)
    assert whole
    count = check_survivors(
        recorded, tmp_path / "survivors", [None, whole], lambda place: read_output(place / name)
    )
    assert count > 8


@pytest.mark.parametrize("packed", [False, True])
def test_append_is_atomic_at_power_loss(packed: bool, inputs: Inputs, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    shutil.copytree(inputs.packed if packed else inputs.set, disk / "a")

    def read_rows(place: Path) -> object:
        opened = open_dataset(place / "a")
        return {name: opened.split(name).table["log_time"].to_pylist() for name in opened.splits}

    before = read_rows(disk)
    recorded = record_command("dataset {more} {out}/a --add", inputs, disk, tmp_path / "log")
    after = read_rows(disk)
    assert before != after
    check_survivors(recorded, tmp_path / "survivors", [before, after], read_rows)


def test_a_pipeline_goes_on_after_a_power_loss(inputs: Inputs, tmp_path: Path) -> None:
    """The pipeline's record of finished steps may be lost but is never wrong."""
    disk = tmp_path / "disk"
    disk.mkdir()
    recorded = record_command("run {chain} --out {out}/a", inputs, disk, tmp_path / "log")
    whole = read_contents(disk / "a")
    (tmp_path / "survivors").mkdir()
    survivors = list(recorded.survivors(tmp_path / "survivors"))
    for moment, place in survivors[:: max(1, len(survivors) // 6)]:
        for name in ("pictures", "pictures.mcap", "short.mcap"):
            if (place / "a" / name).exists():
                assert read_contents(place / "a" / name) == read_contents(disk / "a" / name), moment
        cli("run", inputs.chain, "--out", place / "a")
        made = read_contents(place / "a")  # outputs of other settings are kept in previous/
        assert {k: v for k, v in made.items() if not k.startswith("previous/")} == whole, moment
