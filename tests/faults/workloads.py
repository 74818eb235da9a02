"""Every command that writes, with inputs so small that hundreds of fault trials are cheap."""

import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import pytest

from dmrl.atomic_output import to_partial_path
from dmrl.datasets import open_dataset

from .inputs import Inputs, cli, copy_flights

RECORD_S = 2.5
IGNORED = {"tensorboard", "pipeline.json", "unfinished", "catalogue.parquet"}
"""Names of files that hold times, and so differ each time, and of unfinished outputs."""
Run = Callable[[Inputs, Path], object]


@dataclass(frozen=True, slots=True)
class Workload:
    """A command that writes.

    Parameters
    ----------
    name
        Name of its row in the table.
    run
        Runs the command, given the inputs and the path of the output.
    out
        Name of the output.
    keeps
        Whether the unfinished output stays after an error.
    command
        The command, if the name does not begin with it.
    before
        Makes what the command needs at the path of the output.
    same
        Whether it writes the same bytes each time; otherwise only their number is compared.
    pieces
        Whether its output is a folder of independent files.
    reads
        Returns what each reader finds in the output: at any time the old or the new content.
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
        """The command that it runs."""
        return self.command or self.name.split()[0]


def _train(i: Inputs, out: Path) -> None:
    more = ("--resume",) if to_partial_path(out).is_dir() else ()
    cli("train", i.set, out, *i.training, *more)


def _render(i: Inputs, out: Path) -> None:
    more = ("--resume",) if to_partial_path(out).is_file() else ()
    cli("render", i.scene, out, *more)


def _copy_set(i: Inputs, out: Path) -> None:
    shutil.copytree(i.set, out)


def _copy_packed_set(i: Inputs, out: Path) -> None:
    shutil.copytree(i.packed, out)


def _grow(i: Inputs, out: Path) -> None:
    cli("dataset", i.more, out, "--add")


def _read_rows(out: Path) -> dict[str, object]:
    """Return the times of the rows of a dataset, as dmrl and as `datasets` read them.

    For Arrow shards, `datasets` has a shard list per split, so one split may be newer than another.
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


def _verify(i: Inputs, out: Path) -> None:
    """Run the step `verify` of a pipeline with a ready result; the command writes nothing."""
    verify, result = import_module("dmrl.stages.verify"), pickle.loads(i.proof.read_bytes())
    proof = import_module("dmrl.deploy.c.run.proof")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof, "prove_export", lambda *_, **__: result)
        verify.run(i.c, verify.Settings(), out)


def _record(i: Inputs, out: Path) -> None:
    """Record two simulated robots for `RECORD_S`."""
    drones = import_module("dmrl.simulation.drone_fleet")
    uris = ("udp://127.0.0.1:0",) * 2
    with drones.fleet(i.flight, uris, (), drones.DroneSettings()) as fleet:
        named = [f"--robot={d.robot}=udp://127.0.0.1:{d.port}" for d in fleet.drones]
        cli("record", out, *named, "--duration-s", RECORD_S)


WORKLOADS = (
    Workload("sketch", lambda i, out: cli("sketch", out, "--images", 2), "pictures"),
    Workload("convert", lambda i, out: cli("convert", i.pictures, out), "a.mcap"),
    Workload(
        "convert to csv", lambda i, out: cli("convert", i.moment, out, "--to", "csv"), "tables"
    ),
    Workload("convert to ros2", lambda i, out: cli("convert", i.dots, out, "--to", "ros2"), "bag"),
    Workload("trim", lambda i, out: cli("trim", i.dots, out, "--to-s", 0.9), "a.mcap"),
    Workload(
        "trim a folder",
        lambda i, out: cli("trim", i.flights, out, "--to-s", 0.9, "--workers", 1),
        "flights",
        pieces=True,
    ),
    Workload("merge", lambda i, out: cli("merge", i.dots, i.seen, out), "a.mcap"),
    Workload("recover", lambda i, out: cli("recover", i.cut, out), "a.mcap"),
    Workload(
        "fly",
        lambda i, out: cli("fly", "fly_in_view", out, "--duration-s", 1, "--seed", 1),
        "a.mcap",
    ),
    Workload("label", lambda i, out: cli("label", i.flight, out), "a.mcap"),
    Workload("align", lambda i, out: cli("align", i.pair, out), "a.mcap"),
    Workload("track", lambda i, out: cli("track", i.seen, out), "a.mcap"),
    Workload(
        "calibrate",
        lambda i, out: cli("calibrate", i.boards, out, "--board", "7x5"),
        "camera.toml",
    ),
    Workload(
        "likeness",
        lambda i, out: cli("likeness", i.dots, out / "like.toml"),
        "like",
        before=lambda _, out: out.mkdir(),
        pieces=True,
    ),
    Workload("dataset", lambda i, out: cli("dataset", i.dots, out), "set"),
    Workload("dataset to parquet", lambda i, out: cli("dataset", i.dots, out, "--parquet"), "set"),
    Workload("dataset --add", _grow, "set", before=_copy_set, pieces=True, reads=_read_rows),
    Workload(
        "dataset --add to parquet",
        _grow,
        "set",
        before=_copy_packed_set,
        pieces=True,
        reads=_read_rows,
    ),
    Workload("card", _card, "set", before=_copy_set, pieces=True),
    Workload("predict", lambda i, out: cli("predict", i.model, i.dots, out), "a.mcap"),
    Workload("evaluate", lambda i, out: cli("evaluate", i.found, "--plots", out), "plots"),
    Workload("score", lambda i, out: cli("score", out, "--name", "mine"), "score.json"),
    Workload("index", lambda i, out: cli("index", out), "set", before=copy_flights, pieces=True),
    Workload("report", lambda i, out: cli("report", i.flights, out), "a.html"),
    Workload("train", _train, "model", keeps=True),
    Workload("quantize", lambda i, out: cli("quantize", i.model, i.set, out), "int8"),
    Workload("export", lambda i, out: cli("export", i.int8, out), "c"),
    Workload("verify", _verify, "proof.json"),
    Workload("render", _render, "a.mcap", keeps=True),
    Workload("view", lambda i, out: cli("view", i.dots, "--save", out), "a.rrd", same=False),
    Workload("run", lambda i, out: cli("run", i.chain, "--out", out), "chain", pieces=True),
)
RECORD = Workload("record", _record, "a.mcap", keeps=True, same=False)
"""Not in `WORKLOADS`, since its output is never the same."""
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
"""Commands that only print."""


def find_workload(name: str) -> Workload:
    """Return the workload of this name."""
    return next(work for work in (*WORKLOADS, RECORD) if work.name == name)


def read_contents(path: Path) -> dict[str, bytes]:
    """Return the bytes of every file under a path by relative name, without those `IGNORED`."""
    if path.is_file():
        return {"": path.read_bytes()}
    return {
        str(inner.relative_to(path)): inner.read_bytes()
        for inner in sorted(path.rglob("*"))
        if inner.is_file() and not IGNORED & {*inner.parts}
    }


def clear_folder(folder: Path) -> None:
    """Replace a folder by an empty one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
