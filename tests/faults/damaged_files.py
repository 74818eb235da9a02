"""Use damaged third-party files, in child processes of server.py."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .ending import run_to_end
from .mutate import mutate
from .workloads import Inputs, cli

Use = Callable[[Inputs, Path, Path], None]


@dataclass(frozen=True, slots=True)
class Source:
    """A third-party file or folder, and a command that reads it.

    Parameters
    ----------
    made
        Returns an undamaged one.
    file
        Pattern of the file to damage in a folder.
    use
        Runs the command, given the inputs, the source, and a path to write to.
    """

    made: Callable[[Inputs], Path]
    file: str
    use: Use


def _convert(i: Inputs, source: Path, out: Path) -> None:
    cli("convert", source, out)


def _predict(i: Inputs, source: Path, out: Path) -> None:
    cli("predict", source, i.dots, out)


def _export(i: Inputs, source: Path, out: Path) -> None:
    cli("export", source, out)


def _run(i: Inputs, source: Path, out: Path) -> None:
    cli("run", source, "--out", out, "--workers", 1)


def _train(i: Inputs, source: Path, out: Path) -> None:
    cli("train", source, out, *i.training)


def _render(i: Inputs, source: Path, out: Path) -> None:
    cli("render", source, out)


def _render_with_camera(i: Inputs, source: Path, out: Path) -> None:
    cli("render", i.scene, out, "--camera", source, "--images", 1)


def _evaluate(i: Inputs, source: Path, out: Path) -> None:
    cli("evaluate", source)


SOURCES: dict[str, Source] = {
    "a picture": Source(lambda i: i.pictures, "*.png", _convert),
    "labels of pictures": Source(lambda i: i.pictures, "*.csv", _convert),
    "a recipe of a pipeline": Source(lambda i: i.chain, "", _run),
    "a recipe of renders": Source(lambda i: i.scene, "", _render),
    "a camera": Source(lambda i: i.camera, "", _render_with_camera),
    "a recording that is judged": Source(lambda i: i.found, "", _evaluate),
    "a model's description": Source(lambda i: i.model, "model.json", _predict),
    "a model's weights": Source(lambda i: i.model, "*.safetensors", _predict),
    "an int8 model": Source(lambda i: i.int8, "*.npz", _export),
    "an int8 model's description": Source(lambda i: i.int8, "*.json", _export),
    "a dataset's table": Source(lambda i: i.set, "train/*.arrow", _train),
    "a dataset's manifest": Source(lambda i: i.set, "manifest.json", _train),
    "a dataset's state": Source(lambda i: i.saved, "train/state.json", _train),
    "a dataset's features": Source(lambda i: i.saved, "train/dataset_info.json", _train),
    "a dataset's splits": Source(lambda i: i.saved, "dataset_dict.json", _train),
    "a dataset's provenance": Source(lambda i: i.set, "provenance.json", _train),
}


def use_sound_source(inputs: Inputs, name: str, folder: str) -> int:
    """Copy an undamaged source into the folder and use it; return the exit status, 0."""
    place, source = Path(folder), SOURCES[name]
    sound = source.made(inputs)
    copy = place / sound.name
    shutil.copytree(sound, copy) if sound.is_dir() else shutil.copy(sound, copy)
    status, output = run_to_end(lambda: source.use(inputs, copy, _get_output(place)))
    assert status == 0, output
    _empty(_get_output(place).parent)
    return status


def use_damaged_sources(inputs: Inputs, name: str, folder: str, seed: int, cases: int) -> int:
    """Damage and use a source this many times; return how often it was refused."""
    place, source, rng = Path(folder), SOURCES[name], np.random.default_rng(seed)
    sound = source.made(inputs)
    whole = sound if sound.is_file() else next(iter(sorted(sound.glob(source.file))))
    copy = place / sound.name
    file = copy / whole.relative_to(sound) if sound.is_dir() else copy
    data, refused = whole.read_bytes(), 0
    for k in range(cases):
        damaged = mutate(data, rng)
        file.write_bytes(damaged)
        try:
            status, output = run_to_end(lambda: source.use(inputs, copy, _get_output(place)))
            assert status in (0, 1, 2), status
            assert (status == 0) == _get_output(place).exists() or name.endswith("judged"), output
        except BaseException as e:
            kept = place / f"found-{seed}-{k}{file.suffix}"
            kept.write_bytes(damaged)
            raise AssertionError(f"{name}, seed {seed}, case {k}, {kept}: {e}") from e
        assert file.read_bytes() == damaged
        refused += status != 0
        _empty(_get_output(place).parent)
    file.write_bytes(data)
    return refused


def _get_output(place: Path) -> Path:
    return place / "out" / "a.mcap"


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
