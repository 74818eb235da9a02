"""Files of strangers, damaged or meant to harm: one line or a result, and nothing outside OUT."""

import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dmrl.datasets import open_dataset
from dmrl.formats.format import Options
from dmrl.formats.known import FORMATS
from dmrl.pipeline import run as pipeline
from dmrl.stages import convert, export, predict

from .conftest import Count, cases_of, ended
from .mutate import mutated
from .works import Inputs

# Python 3.12 says that threads of the parent are not in the child; it needs none of them.
pytestmark = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")

HANG_S = 60


def _pictures(inputs: Inputs, source: Path, out: Path) -> None:
    convert.run(source, out / "a.mcap", convert.Settings())


def _images(inputs: Inputs, source: Path, out: Path) -> None:
    for sample in FORMATS["images"].content(source, Options()).samples:
        assert sample.fields


def _recipe(inputs: Inputs, source: Path, out: Path) -> None:
    pipeline.run(source, out / "chain")


def _model(inputs: Inputs, source: Path, out: Path) -> None:
    predict.run(source, inputs.dots, out / "a.mcap", predict.Settings())


def _int8(inputs: Inputs, source: Path, out: Path) -> None:
    export.run(source, out / "c", export.Settings())


def _dataset(inputs: Inputs, source: Path, out: Path) -> None:
    data = open_dataset(source)
    for split in data.splits:
        table = data.split(split)
        for pixels in table.pixels:
            pixels.sum()


Work = Callable[[Inputs, Path, Path], None]
SOURCES: dict[str, tuple[str, str, Work]] = {
    "a picture": ("pictures", "*.png", _images),
    "labels of pictures": ("pictures", "*.csv", _pictures),
    "a recipe": ("chain", "chain.toml", _recipe),
    "a model's description": ("model", "model.json", _model),
    "a model's weights": ("model", "*.safetensors", _model),
    "an int8 model": ("int8", "*.npz", _int8),
    "a dataset's table": ("set", "train/*.arrow", _dataset),
    "a dataset's state": ("set", "train/state.json", _dataset),
    "a dataset's features": ("set", "train/dataset_info.json", _dataset),
    "a dataset's splits": ("set", "dataset_dict.json", _dataset),
    "a dataset's provenance": ("set", "provenance.json", _dataset),
}
QUICK = ("a picture", "a recipe", "labels of pictures")


def damaged(name: str, inputs: Inputs, folder: Path, cases: int, count: Count) -> None:
    """Damage one file of a source again and again, and use it in a process of its own."""
    what, pattern, work = SOURCES[name]
    whole: Path = getattr(inputs, what)
    source = folder / whole.name
    shutil.copytree(whole, source) if whole.is_dir() else shutil.copy(whole, source)
    file = source if source.is_file() else next(iter(sorted(source.glob(pattern))))
    data, rng = file.read_bytes(), np.random.default_rng(len(name))
    out, victim = folder / "out", folder / "victim"
    victim.write_text("precious")
    work(inputs, whole, folder)  # what it takes is loaded before the fork
    refused = 0
    for k in range(cases):
        file.write_bytes(mutated(data, rng))
        out.mkdir()
        before = {p: p.read_bytes() for p in (file, victim)}
        status = in_a_child(lambda: work(inputs, source, out))
        assert status in (0, 1), f"case {k} of {name}: {status}, see {file}"
        refused += status
        assert {p: p.read_bytes() for p in before} == before
        shutil.rmtree(out)
    count(f"damaged: {name}", cases=cases, refused=refused, right=cases - refused)


def in_a_child(work: Callable[[], object]) -> int:
    """Exit status of a command in a process of its own, 70 for a bug; a signal's number below 0."""
    number = os.fork()
    if number:
        return os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
    status = 70
    try:
        signal.alarm(HANG_S)
        status, _ = ended(work)
    except BaseException as e:
        sys.stderr.write(f"{type(e).__name__}: {e}\n")
        sys.stderr.flush()
    os._exit(status)


@pytest.mark.parametrize("name", QUICK)
def test_damaged_files_are_refused_or_used(
    name: str, inputs: Inputs, tmp_path: Path, count: Count
) -> None:
    damaged(name, inputs, tmp_path, 15, count)


@pytest.mark.slow
@pytest.mark.timeout(3000)
@pytest.mark.parametrize("name", SOURCES)
def test_damaged_files_of_every_kind_are_refused_or_used(
    name: str, inputs: Inputs, tmp_path: Path, count: Count
) -> None:
    damaged(name, inputs, tmp_path, cases_of(1000), count)
