"""Power failures at any moment: outputs are complete, and extended ones old or new.

What counts as written is what was synced by then; see `power_loss`. The calls are those of the
command and of its libraries, as the system sees them.
"""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from dmrl.datasets import open_dataset

from .inputs import Inputs, cli, flights
from .power_loss import Recorded
from .workloads import contents

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


def record(words: str, inputs: Inputs, disk: Path, log: Path) -> Recorded:
    """Run a command below a folder, and return what it wrote in which order."""
    known = ("dots", "moment", "int8", "model", "set", "short", "more", "chain")
    places = {name: getattr(inputs, name) for name in known if f"{{{name}}}" in words}
    filled = [word.format(out=disk, **places) for word in words.split()]
    recorded = Recorded(disk)
    recorded.run([sys.executable, "-m", "dmrl", *filled], log)
    return recorded


def check_survivors(
    recorded: Recorded, into: Path, states: list[object], read: Callable[[Path], object]
) -> int:
    """Hold that every survivor is in one of the states, the last of them at the end."""
    into.mkdir()
    count = 0
    for moment, place in recorded.survivors(into):
        allowed = states[-1:] if moment.startswith(f"{recorded.moment} of ") else states
        assert read(place) in allowed, moment
        shutil.rmtree(place)
        count += 1
    return count


def read_output(path: Path) -> object:
    """Return what is in an output; None where there is none."""
    return contents(path) if path.exists() else None


@pytest.mark.parametrize("work", OUTPUTS)
def test_output_is_complete_or_absent_after_power_loss(
    work: str, inputs: Inputs, tmp_path: Path
) -> None:
    words, name = OUTPUTS[work]
    disk = tmp_path / "disk"
    disk.mkdir()
    if work == "index":
        flights(inputs, disk / "a")
    recorded = record(words, inputs, disk, tmp_path / "log")
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
    recorded = record("dataset {more} {out}/a --add", inputs, disk, tmp_path / "log")
    after = read_rows(disk)
    assert before != after
    check_survivors(recorded, tmp_path / "survivors", [before, after], read_rows)


def test_a_pipeline_goes_on_after_a_power_loss(inputs: Inputs, tmp_path: Path) -> None:
    """Its memory of what was made may be lost, and is never wrong."""
    disk = tmp_path / "disk"
    disk.mkdir()
    recorded = record("run {chain} --out {out}/a", inputs, disk, tmp_path / "log")
    whole = contents(disk / "a")
    (tmp_path / "survivors").mkdir()
    survivors = list(recorded.survivors(tmp_path / "survivors"))
    for moment, place in survivors[:: max(1, len(survivors) // 6)]:
        for name in ("pictures", "pictures.mcap", "short.mcap"):
            if (place / "a" / name).exists():
                assert contents(place / "a" / name) == contents(disk / "a" / name), moment
        cli("run", inputs.chain, "--out", place / "a")
        made = contents(place / "a")  # what was made otherwise is kept in previous/
        assert {k: v for k, v in made.items() if not k.startswith("previous/")} == whole, moment
