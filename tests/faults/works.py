"""Every stage that writes, on inputs so small that it can be broken hundreds of times."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dmrl import card
from dmrl.images.codec import encode_png
from dmrl.messages import message
from dmrl.pipeline import run as pipeline
from dmrl.recording import SPLIT_METADATA, Provenance, RecordingWriter
from dmrl.stages import convert, dataset, export, fly, label, merge, quantize, recover, sketch, trim
from dmrl.stages import predict as predict_stage
from dmrl.stages import train as train_stage
from dmrl.topics import attitude, camera_image, labels

STEP_NS = 100_000_000
PIPELINE = """
kind = "pipeline"
[[step]]
stage = "sketch"
out = "pictures"
images = 2
[[step]]
stage = "convert"
source = "pictures"
out = "pictures.mcap"
[[step]]
stage = "dataset"
recordings = ["pictures.mcap"]
out = "set"
"""


@dataclass(frozen=True, slots=True)
class Inputs:
    """Whole inputs in one folder, each made when it is first asked for. No stage may change one."""

    folder: Path

    def made(self, name: str, make: Callable[[Path], object]) -> Path:
        """The input of that name."""
        path = self.folder / name
        if not path.exists():
            make(path)
        return path

    @property
    def dots(self) -> Path:
        """A recording of twelve small images with labels."""
        return self.made("dots.mcap", _dots)

    @property
    def cut(self) -> Path:
        """Two thirds of it."""
        whole = self.dots.read_bytes()
        return self.made("cut.mcap", lambda path: path.write_bytes(whole[: 2 * len(whole) // 3]))

    @property
    def pictures(self) -> Path:
        """Three sketches."""
        return self.made("pictures", lambda path: sketch.run(path, sketch.Settings(images=3)))

    @property
    def flight(self) -> Path:
        """Eight seconds of two robots."""
        settings = fly.Settings(duration_s=8.0, seed=1)
        return self.made("flight.mcap", lambda path: fly.run(path, settings))

    @property
    def chain(self) -> Path:
        """A pipeline."""
        return self.made("chain.toml", lambda path: path.write_text(PIPELINE))

    @property
    def set(self) -> Path:
        """The dataset of ``dots``."""
        return self.made("set", lambda path: dataset.run([self.dots], path, dataset.Settings()))

    @property
    def model(self) -> Path:
        """A network of one epoch."""
        return self.made("model", lambda path: _train(self, path))

    @property
    def int8(self) -> Path:
        """Its int8 form."""
        settings = quantize.Settings()
        return self.made("int8", lambda path: quantize.run(self.model, self.set, path, settings))


@dataclass(frozen=True, slots=True)
class Work:
    """A stage, and the name of its output. A slow one is broken less often."""

    name: str
    run: Callable[[Inputs, Path], object]
    out: str
    slow: bool = False


def prepare(folder: Path) -> Inputs:
    """The inputs of all works."""
    card.plots = None  # figures take longer than all the rest
    quantize.plots = None
    return Inputs(folder)


def _dots(path: Path) -> None:
    """Twelve images of a bright square on dark noise, in chunks of a few, with labels."""
    rng = np.random.default_rng(0)
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.add_metadata(
            SPLIT_METADATA,
            {"train": f"[[0, {7 * STEP_NS}]]", "test": f"[[{8 * STEP_NS}, {11 * STEP_NS}]]"},
        )
        for k in range(12):
            rgb = rng.integers(0, 40, (48, 64, 3), np.uint8)
            row, col = int(rng.integers(1, 5)), int(rng.integers(1, 7))
            rgb[8 * row + 1 : 8 * row + 7, 8 * col + 1 : 8 * col + 7] = 250
            picture = message("CompressedImage")(data=encode_png(rgb), format="png")
            truth = {"peer": "cf2", "u_px": 8 * col + 4, "v_px": 8 * row + 4, "depth_m": 1.2}
            sink.write(k * STEP_NS, camera_image("cf1"), picture)
            sink.write(
                k * STEP_NS,
                labels("cf1"),
                message("PeerLabels")(peers=[{**truth, "source": "truth"}]),
            )
            sink.write(k * STEP_NS + 1, attitude("cf1"), message("Attitude")(roll_rad=k))
            if k % 4 == 3:
                sink.flush()


def _tables(inputs: Inputs, out: Path) -> object:
    return convert.run(inputs.flight, out, convert.Settings(to="csv"))


def _predict(inputs: Inputs, out: Path) -> object:
    return predict_stage.run(inputs.model, inputs.dots, out, predict_stage.Settings())


def _train(inputs: Inputs, out: Path) -> object:
    settings = train_stage.Settings(epochs=1, batch_size=4, device="cpu", validation_share=0.0)
    return train_stage.run(inputs.set, out, settings)


WORKS = (
    Work("sketch", lambda i, out: sketch.run(out, sketch.Settings(images=2)), "pictures", True),
    Work("convert", lambda i, out: convert.run(i.pictures, out, convert.Settings()), "a.mcap"),
    Work("convert to csv", _tables, "tables", True),
    Work("trim", lambda i, out: trim.run(i.dots, out, trim.Settings(to_s=0.9)), "a.mcap"),
    Work("merge", lambda i, out: merge.run([i.dots, i.flight], out), "a.mcap"),
    Work("recover", lambda i, out: recover.run(i.cut, out), "a.mcap"),
    Work("fly", lambda i, out: fly.run(out, fly.Settings(duration_s=1.0, seed=1)), "a.mcap", True),
    Work("label", lambda i, out: label.run(i.flight, out, label.Settings()), "a.mcap", True),
    Work("dataset", lambda i, out: dataset.run([i.dots], out, dataset.Settings()), "set", True),
    Work(
        "dataset to parquet",
        lambda i, out: dataset.run([i.dots], out, dataset.Settings(parquet=True)),
        "set",
        True,
    ),
    Work("predict", _predict, "a.mcap", True),
    Work("train", _train, "model", True),
    Work(
        "quantize",
        lambda i, out: quantize.run(i.model, i.set, out, quantize.Settings()),
        "int8",
        True,
    ),
    Work("export", lambda i, out: export.run(i.int8, out, export.Settings()), "c", True),
    Work("run", lambda i, out: pipeline.run(i.chain, out), "chain", True),
)


def contents(path: Path) -> dict[str, bytes]:
    """Everything under a path, by name; what tells times is left out."""
    if path.is_file():
        return {"": path.read_bytes()}
    return {
        str(inner.relative_to(path)): inner.read_bytes()
        for inner in sorted(path.rglob("*"))
        if inner.is_file() and "tensorboard" not in inner.parts
    }


def clear(folder: Path) -> None:
    """An empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
