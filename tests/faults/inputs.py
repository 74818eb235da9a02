"""Inputs of every command, each made once and as small as possible."""

import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name

import numpy as np
import pytest

from dmrl.cli import app
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.recording import SPLIT_METADATA, Provenance, RecordingWriter
from dmrl.topics import ATTITUDE, CAMERA_IMAGE, LABELS, RANGE

from ..pipeline.chain import CHAIN
from ..stages.detector import with_detections

STEP_NS = 100_000_000
STAND_INS = {
    "render": (
        ("dmrl.rendering.renderer:", "WorkerPool", "Painters"),
        ("dmrl.rendering.renderer:", "list_shipped_panoramas", "sky"),
        ("dmrl.render_recording:", "ensure_environment", "no_python"),
    ),
    "run": (("dmrl.pipeline.process_pool:", "subprocess", "Processes"),),
    "trim": (("dmrl.pipeline.process_pool:", "subprocess", "Processes"),),
    "evaluate": (("matplotlib.figure:Figure", "draw", "blank"),),
    "likeness": tuple(
        ("dmrl.rendering.preset_fitting:", name, "FEW") for name in ("COARSE", "FINE")
    ),
    "index": (("dmrl.pipeline.process_pool:", "subprocess", "Processes"),),
    "report": (("matplotlib.figure:Figure", "draw", "blank"),),
    "quantize": (("dmrl.evaluation.quantization_report:", "plots", "nothing"),),
}
"""By command: module or class, attribute to replace, and its substitute in stand_ins.py."""
SHORT = """
kind = "train"
architecture = "locanet"
epochs = 1
batch_size = 4
validation_share = 0.0
"""
SCENE = """
kind = "render"
images = 2
robots_max = 2
empty_share = 0.0
workers = 1
seed = 3
"""


@dataclass(frozen=True, slots=True)
class Inputs:
    """Valid inputs in one folder, each made on first use. No stage may change one."""

    folder: Path

    def make_once(self, name: str, make: Callable[[Path], object]) -> Path:
        """Return the input of this name; make it if it does not exist."""
        path = self.folder / name
        if not path.exists():
            make(path)
        return path

    @property
    def dots(self) -> Path:
        """A recording of twelve small images with labels."""
        return self.make_once("dots.mcap", write_dots)

    @property
    def cut(self) -> Path:
        """The first two thirds of ``dots``, as a truncated file."""
        whole = self.dots.read_bytes()
        return self.make_once(
            "cut.mcap", lambda path: path.write_bytes(whole[: 2 * len(whole) // 3])
        )

    @property
    def pictures(self) -> Path:
        """A folder with three sketches."""
        return self.make_once("pictures", lambda path: cli("sketch", path, "--images", 3))

    @property
    def flight(self) -> Path:
        """A simulated flight of two robots for 8 s."""
        flags = "--duration-s", 8, "--seed", 1
        return self.make_once("flight.mcap", lambda path: cli("fly", "fly_in_view", path, *flags))

    @property
    def moment(self) -> Path:
        """The first second of ``flight``."""
        return self.make_once(
            "moment.mcap", lambda path: cli("trim", self.flight, path, "--to-s", 1)
        )

    @property
    def flights(self) -> Path:
        """A folder with two recordings."""
        return self.make_once("flights", lambda path: copy_flights(self, path))

    @property
    def indexed(self) -> Path:
        """``flights`` with a catalogue."""
        return self.make_once(
            "indexed", lambda path: (copy_flights(self, path), cli("index", path))
        )

    @property
    def seen(self) -> Path:
        """``flight`` with detections."""
        return self.make_once("seen.mcap", lambda path: with_detections(self.flight, path))

    @property
    def pair(self) -> Path:
        """Ranges of two robots for 28 s; one clock is 0.08 s ahead."""
        return self.make_once("pair.mcap", write_pair)

    @property
    def boards(self) -> Path:
        """A folder with images of a chessboard."""
        return self.make_once("boards", draw_boards)

    @property
    def camera(self) -> Path:
        """A camera file."""
        flags = "--board", "7x5"
        return self.make_once(
            "camera.toml", lambda path: cli("calibrate", self.boards, path, *flags)
        )

    @property
    def chain(self) -> Path:
        """A recipe of a pipeline."""
        return self.make_once("chain.toml", lambda path: path.write_text(CHAIN))

    @property
    def short(self) -> Path:
        """A recipe of a training of one epoch."""
        return self.make_once("short.toml", lambda path: path.write_text(SHORT))

    @property
    def scene(self) -> Path:
        """A recipe of two renders."""
        return self.make_once("scene.toml", lambda path: path.write_text(SCENE))

    @property
    def set(self) -> Path:
        """The dataset of ``dots``."""
        return self.make_once("set", lambda path: cli("dataset", self.dots, path))

    @property
    def more(self) -> Path:
        """A recording of twelve other images."""
        return self.make_once("more.mcap", lambda path: write_dots(path, seed=1))

    @property
    def packed(self) -> Path:
        """A dataset of ``dots`` in Parquet."""
        return self.make_once("packed", lambda path: cli("dataset", self.dots, path, "--parquet"))

    @property
    def saved(self) -> Path:
        """``set`` without a manifest, as the library `datasets` would save it."""
        return self.make_once("saved", self._saved)

    def _saved(self, path: Path) -> None:
        shutil.copytree(self.set, path, ignore=shutil.ignore_patterns("manifest.json", "parts"))

    @property
    def model(self) -> Path:
        """A network trained for one epoch."""
        return self.make_once("model", lambda path: cli("train", self.set, path, *self.training))

    @property
    def training(self) -> tuple[object, ...]:
        """Flags of the training of ``model``."""
        return "--recipe", self.short, "--device", "cpu"

    @property
    def found(self) -> Path:
        """``dots`` with its detections."""
        return self.make_once(
            "found.mcap", lambda path: cli("predict", self.model, self.dots, path)
        )

    @property
    def int8(self) -> Path:
        """``model``, quantized to int8."""
        return self.make_once("int8", lambda path: cli("quantize", self.model, self.set, path))

    @property
    def proof(self) -> Path:
        """The pickled result of `dmrl verify` for ``c``."""
        return self.make_once("proof", lambda path: verify_export(self, path))

    @property
    def c(self) -> Path:
        """``int8``, exported to C."""
        return self.make_once("c", lambda path: cli("export", self.int8, path))


def cli(*words: object) -> None:
    """Run a dmrl command with the substitutes of `STAND_INS`.

    Raises
    ------
    SystemExit
        With its exit status, unless that is 0.
    """
    with pytest.MonkeyPatch.context() as patch:
        for place, name, other in STAND_INS.get(str(words[0]), ()):
            stand_in = getattr(import_module(".stand_ins", __package__), other)
            patch.setattr(resolve_name(place), name, stand_in)
        try:
            app([str(word) for word in words])
        except SystemExit as e:
            if e.code:
                raise


def write_dots(path: Path, seed: int = 0) -> None:
    """Write twelve labelled images of a bright square on dark noise, four to a chunk."""
    rng = np.random.default_rng(seed)
    with RecordingWriter(path, Provenance("test")) as sink:
        sink.add_metadata(
            SPLIT_METADATA,
            {"train": f"[[0, {7 * STEP_NS}]]", "test": f"[[{8 * STEP_NS}, {11 * STEP_NS}]]"},
        )
        for k in range(12):
            rgb = rng.integers(0, 40, (48, 64, 3), np.uint8)
            row, col = int(rng.integers(1, 5)), int(rng.integers(1, 7))
            rgb[8 * row + 1 : 8 * row + 7, 8 * col + 1 : 8 * col + 7] = 250
            picture = message_class("CompressedImage")(data=encode_png(rgb), format="png")
            truth = {"peer": "cf2", "u_px": 8 * col + 4, "v_px": 8 * row + 4, "depth_m": 1.2}
            sink.write(k * STEP_NS, CAMERA_IMAGE("cf1"), picture)
            sink.write(
                k * STEP_NS,
                LABELS("cf1"),
                message_class("PeerLabels")(peers=[{**truth, "source": "truth"}]),
            )
            sink.write(k * STEP_NS + 1, ATTITUDE("cf1"), message_class("Attitude")(roll_rad=k))
            if k % 4 == 3:
                sink.flush()


def copy_flights(inputs: Inputs, folder: Path) -> None:
    """Make a folder with two copies of ``dots``."""
    folder.mkdir()
    for name in "ab":
        shutil.copy(inputs.dots, folder / f"{name}.mcap")


def write_pair(path: Path) -> None:
    """Write ranges between two robots, metres; the stamps of cf2 are 0.08 s late."""
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.03, 0.05, 700))
    measured = 3 + 0.5 * np.sin(time) + 0.4 * np.sin(1.7 * time) + rng.normal(0, 0.05, len(time))
    with RecordingWriter(path, Provenance("test")) as sink:
        for at_s, value in zip(time.tolist(), measured.tolist(), strict=True):
            ranged = message_class("UwbRange")(range_m=value)
            sink.write(round(at_s * 1e9), RANGE("cf1", "cf2"), ranged)
            sink.write(round((at_s + 0.08) * 1e9), RANGE("cf2", "cf1"), ranged)


def draw_boards(folder: Path) -> None:
    """Draw seven images of a chessboard."""
    boards = import_module("..estimation.boards", __package__)
    rng = np.random.default_rng(0)
    folder.mkdir()
    for k in range(7):
        grey = boards.render_board(*boards.draw_pose(rng))
        (folder / f"{k}.png").write_bytes(encode_png(np.repeat(grey[..., None], 3, axis=2)))


def verify_export(i: Inputs, out: Path) -> None:
    """Pickle the result of `dmrl verify` with gcc."""
    verify = import_module("dmrl.stages.verify")
    settings = verify.Settings(images=1, noise=1, targets=("gcc",))
    out.write_bytes(pickle.dumps(verify.run(i.c, settings)))
