"""Read damaged third-party files, in children of the process of server.py."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .ending import ended
from .mutate import mutated
from .workloads import Inputs, cli

Use = Callable[[Inputs, Path, Path], None]


@dataclass(frozen=True, slots=True)
class Source:
    """A file or folder of a stranger.

    Parameters
    ----------
    made
        A sound one.
    file
        Pattern of the file in it that is damaged.
    use
        What reads it: inputs, source, and a path to write to.
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


def _seen_by(i: Inputs, source: Path, out: Path) -> None:
    cli("render", i.scene, out, "--camera", source, "--images", 1)


def _evaluate(i: Inputs, source: Path, out: Path) -> None:
    cli("evaluate", source)


SOURCES: dict[str, Source] = {
    "a picture": Source(lambda i: i.pictures, "*.png", _convert),
    "labels of pictures": Source(lambda i: i.pictures, "*.csv", _convert),
    "a recipe of a pipeline": Source(lambda i: i.chain, "", _run),
    "a recipe of renders": Source(lambda i: i.scene, "", _render),
    "a camera": Source(lambda i: i.camera, "", _seen_by),
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


def begin(inputs: Inputs, name: str, folder: str) -> int:
    """Copy a sound source into the folder, and use it: the exit status."""
    place, source = Path(folder), SOURCES[name]
    sound = source.made(inputs)
    copy = place / sound.name
    shutil.copytree(sound, copy) if sound.is_dir() else shutil.copy(sound, copy)
    status, output = ended(lambda: source.use(inputs, copy, _out(place)))
    assert status == 0, output
    _clear(_out(place).parent)
    return status


def damage(inputs: Inputs, name: str, folder: str, seed: int, cases: int) -> int:
    """Damage it again and again, and use it: how often it was refused."""
    place, source, rng = Path(folder), SOURCES[name], np.random.default_rng(seed)
    sound = source.made(inputs)
    whole = sound if sound.is_file() else next(iter(sorted(sound.glob(source.file))))
    copy = place / sound.name
    file = copy / whole.relative_to(sound) if sound.is_dir() else copy
    data, refused = whole.read_bytes(), 0
    for k in range(cases):
        damaged = mutated(data, rng)
        file.write_bytes(damaged)
        try:
            status, output = ended(lambda: source.use(inputs, copy, _out(place)))
            assert status in (0, 1, 2), status
            assert (status == 0) == _out(place).exists() or name.endswith("judged"), output
        except BaseException as e:
            kept = place / f"found-{seed}-{k}{file.suffix}"
            kept.write_bytes(damaged)
            raise AssertionError(f"{name}, seed {seed}, case {k}, {kept}: {e}") from e
        assert file.read_bytes() == damaged
        refused += status != 0
        _clear(_out(place).parent)
    file.write_bytes(data)
    return refused


def _out(place: Path) -> Path:
    return place / "out" / "a.mcap"


def _clear(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
