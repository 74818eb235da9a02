"""Every command that writes, on inputs so small that it can be broken hundreds of times."""

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
from dmrl.datasets import open_dataset
from dmrl.images.codec import encode_png
from dmrl.messages import message
from dmrl.output import partial_of
from dmrl.recording import SPLIT_METADATA, Provenance, RecordingWriter
from dmrl.topics import attitude, camera_image, labels, uwb_range

from ..stages.detector import with_detections

RECORD_S = 2.5
STEP_NS = 100_000_000
TIMED = {"tensorboard", "pipeline.json", "unfinished", "catalogue.parquet"}
"""Names of what tells when something was made, and differs each time; of what is not done."""
STAND_INS = {
    "render": (
        ("dmrl.rendering.renderer:", "Pool", "Painters"),
        ("dmrl.rendering.renderer:", "shipped_lights", "sky"),
        ("dmrl.stages.render:", "ensure", "no_python"),
    ),
    "run": (("dmrl.pipeline.crew:", "subprocess", "Processes"),),
    "trim": (("dmrl.pipeline.crew:", "subprocess", "Processes"),),
    "evaluate": (("matplotlib.figure:Figure", "draw", "blank"),),
    "likeness": tuple(("dmrl.rendering.fitting:", name, "FEW") for name in ("PICTURES", "ROUNDS")),
    "index": (("dmrl.pipeline.crew:", "subprocess", "Processes"),),
    "report": (("matplotlib.figure:Figure", "draw", "blank"),),
    "dataset": (("dmrl.card:", "plots", "nothing"),),
    "card": (("dmrl.card:", "plots", "nothing"),),
    "quantize": (("dmrl.stages.quantize:", "plots", "nothing"),),
}
"""By command: where, what, and the name in stand_ins.py of what takes its place."""
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
stage = "trim"
recording = "pictures.mcap"
to_s = 0.5
out = "short.mcap"
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
        return self.made("pictures", lambda path: cli("sketch", path, "--images", 3))

    @property
    def flight(self) -> Path:
        """Eight seconds of two robots."""
        flags = "--duration-s", 8, "--seed", 1
        return self.made("flight.mcap", lambda path: cli("fly", "fly_in_view", path, *flags))

    @property
    def moment(self) -> Path:
        """A second of it."""
        return self.made("moment.mcap", lambda path: cli("trim", self.flight, path, "--to-s", 1))

    @property
    def flights(self) -> Path:
        """A folder with two recordings."""
        return self.made("flights", lambda path: _flights(self, path))

    @property
    def indexed(self) -> Path:
        """The same with a catalogue."""
        return self.made("indexed", lambda path: (_flights(self, path), cli("index", path)))

    @property
    def seen(self) -> Path:
        """The same with detections."""
        return self.made("seen.mcap", lambda path: with_detections(self.flight, path))

    @property
    def pair(self) -> Path:
        """Half a minute of two robots' ranges; the clock of one is ahead."""
        return self.made("pair.mcap", _pair)

    @property
    def boards(self) -> Path:
        """Pictures of a chessboard."""
        return self.made("boards", _boards)

    @property
    def camera(self) -> Path:
        """A camera file."""
        flags = "--board", "7x5"
        return self.made("camera.toml", lambda path: cli("calibrate", self.boards, path, *flags))

    @property
    def chain(self) -> Path:
        """A pipeline."""
        return self.made("chain.toml", lambda path: path.write_text(PIPELINE))

    @property
    def short(self) -> Path:
        """A training of one epoch."""
        return self.made("short.toml", lambda path: path.write_text(SHORT))

    @property
    def scene(self) -> Path:
        """Two renders."""
        return self.made("scene.toml", lambda path: path.write_text(SCENE))

    @property
    def set(self) -> Path:
        """The dataset of ``dots``."""
        return self.made("set", lambda path: cli("dataset", self.dots, path))

    @property
    def more(self) -> Path:
        """Twelve other images."""
        return self.made("more.mcap", lambda path: _dots(path, seed=1))

    @property
    def packed(self) -> Path:
        """A dataset of ``dots`` in Parquet."""
        return self.made("packed", lambda path: cli("dataset", self.dots, path, "--parquet"))

    @property
    def saved(self) -> Path:
        """``set`` without a manifest, as if `datasets` had saved it."""
        return self.made("saved", self._saved)

    def _saved(self, path: Path) -> None:
        shutil.copytree(self.set, path, ignore=shutil.ignore_patterns("manifest.json", "parts"))

    @property
    def model(self) -> Path:
        """A network of one epoch."""
        return self.made("model", lambda path: cli("train", self.set, path, *self.training))

    @property
    def training(self) -> tuple[object, ...]:
        """Flags of that training."""
        return "--recipe", self.short, "--device", "cpu"

    @property
    def found(self) -> Path:
        """``dots`` with its detections."""
        return self.made("found.mcap", lambda path: cli("predict", self.model, self.dots, path))

    @property
    def int8(self) -> Path:
        """Its int8 form."""
        return self.made("int8", lambda path: cli("quantize", self.model, self.set, path))

    @property
    def proof(self) -> Path:
        """What `dmrl verify` found in it."""
        return self.made("proof", lambda path: _tried(self, path))

    @property
    def c(self) -> Path:
        """Its C."""
        return self.made("c", lambda path: cli("export", self.int8, path))


Run = Callable[[Inputs, Path], object]


@dataclass(frozen=True, slots=True)
class Work:
    """A command that writes.

    Parameters
    ----------
    name
        Its row.
    run
        Writes to a path.
    out
        Name of what it writes.
    keeps
        What it had done stays unfinished after an error.
    command
        Which one it is, if its name does not begin so.
    before
        What has to be there.
    same
        Whether it writes the same bytes each time; else they are about as many.
    pieces
        Whether its output is a folder whose parts stand by themselves.
    reads
        Who else reads the output, and what each finds: as before or as after, at every moment.
    """

    name: str
    run: Run
    out: str
    keeps: bool = False
    command: str = ""
    before: Run | None = None
    same: bool = True
    pieces: bool = False
    reads: Callable[[Path], dict[str, object]] | None = None

    @property
    def of(self) -> str:
        """The command."""
        return self.command or self.name.split()[0]


def cli(*words: object) -> None:
    """A command line.

    Raises
    ------
    SystemExit
        With its exit status, unless that is 0.
    """
    for place, name, other in STAND_INS.get(str(words[0]), ()):
        stand_in = getattr(import_module(".stand_ins", __package__), other)
        setattr(resolve_name(place), name, stand_in)
    try:
        app([str(word) for word in words])
    except SystemExit as e:
        if e.code:
            raise


def _dots(path: Path, seed: int = 0) -> None:
    """Twelve images of a bright square on dark noise, in chunks of a few, with labels."""
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


def _flights(inputs: Inputs, folder: Path) -> None:
    folder.mkdir()
    for name in "ab":
        shutil.copy(inputs.dots, folder / f"{name}.mcap")


def _pair(path: Path) -> None:
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.03, 0.05, 700))
    measured = 3 + 0.5 * np.sin(time) + 0.4 * np.sin(1.7 * time) + rng.normal(0, 0.05, len(time))
    with RecordingWriter(path, Provenance("test")) as sink:
        for at_s, value in zip(time.tolist(), measured.tolist(), strict=True):
            ranged = message("UwbRange")(range_m=value)
            sink.write(round(at_s * 1e9), uwb_range("cf1", "cf2"), ranged)
            sink.write(round((at_s + 0.08) * 1e9), uwb_range("cf2", "cf1"), ranged)


def _boards(folder: Path) -> None:
    boards = import_module("..estimation.boards", __package__)
    rng = np.random.default_rng(0)
    folder.mkdir()
    for k in range(7):
        grey = boards.picture(*boards.pose(rng))
        (folder / f"{k}.png").write_bytes(encode_png(np.repeat(grey[..., None], 3, axis=2)))


def _train(i: Inputs, out: Path) -> None:
    more = ("--resume",) if partial_of(out).is_dir() else ()
    cli("train", i.set, out, *i.training, *more)


def _render(i: Inputs, out: Path) -> None:
    more = ("--resume",) if partial_of(out).is_file() else ()
    cli("render", i.scene, out, *more)


def _copied(i: Inputs, out: Path) -> None:
    shutil.copytree(i.set, out)


def _copied_packed(i: Inputs, out: Path) -> None:
    shutil.copytree(i.packed, out)


def _grow(i: Inputs, out: Path) -> None:
    cli("dataset", i.more, out, "--add")


def _rows_read(out: Path) -> dict[str, object]:
    """Times of the rows that dmrl finds in a dataset, and those that `datasets` finds.

    Of shards in Arrow `datasets` has a list for each split: here one may be longer already.
    """
    datasets = import_module("datasets")
    opened = open_dataset(out)
    ours = {name: opened.split(name).table["log_time"].to_pylist() for name in opened.splits}
    if opened.parquet:
        found = datasets.load_dataset(str(out), streaming=True)
        theirs = {name: [row["log_time"] for row in rows] for name, rows in found.items()}
        return {"dmrl": ours, "datasets": theirs}
    found = datasets.load_from_disk(str(out))
    return {
        "dmrl": ours,
        **{f"datasets, {name}": own["log_time"][:] for name, own in found.items()},
    }


def _card(i: Inputs, out: Path) -> None:
    cli("card", out, "--title", "Another")


def _tried(i: Inputs, out: Path) -> None:
    verify = import_module("dmrl.stages.verify")
    settings = verify.Settings(images=1, noise=1, targets=("gcc",))
    out.write_bytes(pickle.dumps(verify.run(i.c, settings)))


def _verify(i: Inputs, out: Path) -> None:
    """As a step of a pipeline, once gcc has had its say: the command writes nothing."""
    verify, tried = import_module("dmrl.stages.verify"), pickle.loads(i.proof.read_bytes())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verify, "_tried", lambda *_: tried)
        verify.run(i.c, verify.Settings(), out)


def _record(i: Inputs, out: Path) -> None:
    """Two robots for a second, and the robots themselves."""
    fake_drone = import_module("dmrl.stages.fake_drone")
    uris = ("udp://127.0.0.1:0",) * 2
    with fake_drone.fleet(i.flight, uris, (), fake_drone.Settings()) as fleet:
        named = [f"--robot={d.robot}=udp://127.0.0.1:{d.port}" for d in fleet.drones]
        cli("record", out, *named, "--duration-s", RECORD_S)


WORKS = (
    Work("sketch", lambda i, out: cli("sketch", out, "--images", 2), "pictures"),
    Work("convert", lambda i, out: cli("convert", i.pictures, out), "a.mcap"),
    Work("convert to csv", lambda i, out: cli("convert", i.moment, out, "--to", "csv"), "tables"),
    Work("convert to ros2", lambda i, out: cli("convert", i.dots, out, "--to", "ros2"), "bag"),
    Work("trim", lambda i, out: cli("trim", i.dots, out, "--to-s", 0.9), "a.mcap"),
    Work(
        "trim a folder",
        lambda i, out: cli("trim", i.flights, out, "--to-s", 0.9, "--workers", 1),
        "flights",
        pieces=True,
    ),
    Work("merge", lambda i, out: cli("merge", i.dots, i.seen, out), "a.mcap"),
    Work("recover", lambda i, out: cli("recover", i.cut, out), "a.mcap"),
    Work(
        "fly",
        lambda i, out: cli("fly", "fly_in_view", out, "--duration-s", 1, "--seed", 1),
        "a.mcap",
    ),
    Work("label", lambda i, out: cli("label", i.flight, out), "a.mcap"),
    Work("align", lambda i, out: cli("align", i.pair, out), "a.mcap"),
    Work("track", lambda i, out: cli("track", i.seen, out), "a.mcap"),
    Work(
        "calibrate",
        lambda i, out: cli("calibrate", i.boards, out, "--board", "7x5"),
        "camera.toml",
    ),
    Work(
        "likeness",
        lambda i, out: cli("likeness", i.dots, out / "like.toml"),
        "like",
        before=lambda _, out: out.mkdir(),
        pieces=True,
    ),
    Work("dataset", lambda i, out: cli("dataset", i.dots, out), "set"),
    Work("dataset to parquet", lambda i, out: cli("dataset", i.dots, out, "--parquet"), "set"),
    Work("dataset --add", _grow, "set", before=_copied, pieces=True, reads=_rows_read),
    Work(
        "dataset --add to parquet",
        _grow,
        "set",
        before=_copied_packed,
        pieces=True,
        reads=_rows_read,
    ),
    Work("card", _card, "set", before=_copied, pieces=True),
    Work("predict", lambda i, out: cli("predict", i.model, i.dots, out), "a.mcap"),
    Work("evaluate", lambda i, out: cli("evaluate", i.found, "--plots", out), "plots"),
    Work("index", lambda i, out: cli("index", out), "set", before=_flights, pieces=True),
    Work("report", lambda i, out: cli("report", i.flights, out), "a.html"),
    Work("train", _train, "model", keeps=True),
    Work("quantize", lambda i, out: cli("quantize", i.model, i.set, out), "int8"),
    Work("export", lambda i, out: cli("export", i.int8, out), "c"),
    Work("verify", _verify, "proof.json"),
    Work("render", _render, "a.mcap", keeps=True),
    Work("view", lambda i, out: cli("view", i.dots, "--save", out), "a.rrd", same=False),
    Work("run", lambda i, out: cli("run", i.chain, "--out", out), "chain", pieces=True),
)


RECORD = Work("record", _record, "a.mcap", keeps=True, same=False)
"""Apart from the others: it writes what comes in, and that is never the same."""


READS: dict[str, Run] = {
    "info": lambda i, _: cli("info", i.dots),
    "info as JSON": lambda i, _: cli("info", i.dots, "--json"),
    "check": lambda i, _: cli("check", i.flight),
    "evaluate to read": lambda i, _: cli("evaluate", i.found),
    "find": lambda i, _: cli("find", "true", i.indexed),
    "find as JSON": lambda i, _: cli("find", "true", i.indexed, "--json"),
    "doctor": lambda _, __: cli("doctor"),
    "verify to read": lambda i, _: cli(
        "verify", i.c, "--images", 1, "--noise", 1, "--targets", "gcc"
    ),
    "help": lambda _, __: cli("--help"),
}
"""Commands that only say something."""


def work_named(name: str) -> Work:
    """The work of that name."""
    return next(work for work in (*WORKS, RECORD) if work.name == name)


def contents(path: Path) -> dict[str, bytes]:
    """Everything under a path, by name; what tells times is left out."""
    if path.is_file():
        return {"": path.read_bytes()}
    return {
        str(inner.relative_to(path)): inner.read_bytes()
        for inner in sorted(path.rglob("*"))
        if inner.is_file() and not TIMED & {*inner.parts}
    }


def clear(folder: Path) -> None:
    """An empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
