"""``dmrl export``: a network as files that run elsewhere: ONNX, and C for a microcontroller."""

import json
import shutil
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, validators

from dmrl.atomic_output import partial_folder, refuse_existing
from dmrl.deploy.backends import seen_by
from dmrl.deploy.c import L1_FOR_STATE, STACKS_BYTES, write_c
from dmrl.deploy.c.run.measure import Memory, memory_of
from dmrl.deploy.detector import (
    DESCRIPTION_NAME,
    FLOAT_ONNX_NAME,
    INT8_ONNX_NAME,
    WEIGHTS_NAME,
)
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.store import INTEGER_NAME, load
from dmrl.deploy.samples import SAMPLES_NAME, load_samples
from dmrl.errors import MissingExtra, ModelError, SettingError
from dmrl.learn.pretrained import resolved
from dmrl.recording import provenance
from dmrl.terminal.arguments import AsJson, Flat
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_json, print_line, print_table


@dataclass(frozen=True, slots=True)
class Settings:
    """What is written.

    Parameters
    ----------
    bayer
        The C takes raw colour mosaics, as the AI-deck's camera gives them, unless it is compiled
        otherwise.
    refine
        Write C that learns on in the last layer too, from images of which it is told who is in
        view. The state then holds all that the last layer reads.
    l1_kb
        The C works in a near memory of so many kilobytes, 8 of which are left for stacks, such as
        the 64 of a GAP8's L1: rings that do not fit lie in a far one, and rows are copied.
    """

    bayer: bool = False
    refine: bool = False
    l1_kb: Annotated[int | None, Parameter(validator=validators.Number(gte=9))] = None


@dataclass(frozen=True, slots=True)
class Written:
    """One file, what it is, and its bytes."""

    name: str
    what: str
    size_bytes: int


WHAT = {
    FLOAT_ONNX_NAME: "float ONNX: image in, maps out",
    INT8_ONNX_NAME: "int8 ONNX (QDQ): the fast way on a computer, with onnxruntime",
    INTEGER_NAME: "the int8 network as arrays: what dmrl verify compares with",
    SAMPLES_NAME: "images to verify on",
    DESCRIPTION_NAME: "size of the image, outputs, threshold",
}


def run(model: Path, out: Path, settings: Settings) -> list[Written]:
    """Write ``model`` into the folder ``out``: ONNX, and int8 ONNX and C where it is quantised.

    Parameters
    ----------
    model
        Quantised model; or a run folder, .safetensors or Keras .h5: then float ONNX alone.
    out
        Folder to write. Must not exist.
    settings
        See `Settings`.

    Raises
    ------
    ModelError
        If the model cannot be used, or has a layer that cannot be carried.
    MissingExtra
        If torch or onnx is not installed.
    OutputError
        If ``out`` exists.
    SettingError
        If two memories are wanted with ``refine``, or the near one is too small.
    """
    if settings.refine and settings.l1_kb is not None:
        raise SettingError(
            "--refine holds all that the last layer reads, in one memory. Leave out --l1-kb"
        )
    refuse_existing(out)
    model = resolved(model)
    if (model / FLOAT_ONNX_NAME).is_file() and not (model / WEIGHTS_NAME).is_file():
        raise ModelError(f"{model} is an export folder already. Give the model it was made from")
    try:
        learned = import_module("dmrl.learn.inference.loaded_model")
        written = import_module("dmrl.deploy.onnx.float_model")
    except ModuleNotFoundError as e:
        raise MissingExtra(str(e.name), "train", "dmrl export") from None
    trained = learned.load_model(model)
    network = load(model) if (model / INTEGER_NAME).is_file() else None
    libraries = ("torch", "onnx", "numpy")
    made = provenance("export", settings, (model,), libraries=libraries)
    with partial_folder(out) as folder:
        grey = network is not None and network.channels == 1
        (folder / FLOAT_ONNX_NAME).write_bytes(written.float_onnx_of(trained, grey=grey))
        if network is not None:
            _write_int8(network, model, folder, settings)
        said = learned.describe(trained) | {"channels": 1 if grey else 3}
        text = json.dumps(said, indent=1) + "\n"
        (folder / DESCRIPTION_NAME).write_text(text, encoding="utf-8")
        made.write(folder)
    if network is None:
        say(f"no int8 and no C: {model} is float. For those: dmrl quantize {model} DATASET OUT")
    return [_written(path) for path in sorted(out.iterdir())]


def _write_int8(network: IntegerNetwork, model: Path, folder: Path, settings: Settings) -> None:
    int8_onnx = import_module("dmrl.deploy.onnx.graph_writer").int8_onnx
    (folder / INT8_ONNX_NAME).write_bytes(int8_onnx(network))
    for name in (INTEGER_NAME, SAMPLES_NAME):
        shutil.copyfile(model / name, folder / name)
    images = [seen_by(network, image) for image in load_samples(model)]
    near = None if settings.l1_kb is None else settings.l1_kb * 1024 - STACKS_BYTES
    write_c(network, folder, images, bayer=settings.bayer, refine=settings.refine, near_bytes=near)


def _written(path: Path) -> Written:
    what = WHAT.get(path.name, "C" if path.suffix in (".c", ".h") else "")
    return Written(path.name, what, path.stat().st_size)


def document(out: Path, written: list[Written]) -> dict[str, Any]:
    """What was written, as JSON values; without an int8 network nothing is said of its memory."""
    said = {"folder": str(out), "files": {each.name: each.size_bytes for each in written}}
    kept = _memory(out, written)
    return {**said, **asdict(kept), "fits_gap8_l1": kept.fits_l1} if kept else said


def _memory(out: Path, written: list[Written]) -> Memory | None:
    """What the C keeps; None: there is none."""
    int8 = any(each.name == INTEGER_NAME for each in written)
    return memory_of(load(out), out) if int8 else None


DEFAULTS = Settings()


def command(
    model: Path,
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    as_json: AsJson = False,
) -> None:
    """Write a network as ONNX and as C.

    Parameters
    ----------
    model
        What dmrl quantize wrote. A run folder, a .safetensors or a Keras .h5 becomes float ONNX
        alone.
    out
        Folder to write. Must not exist.
    as_json
        Print one JSON document in place of the table.
    """
    written = run(model, out, settings)
    if as_json:
        print_json(document(out, written))
        return
    rows = [(each.name, each.size_bytes, each.what) for each in written]
    print_table(str(out), ("file", "bytes", "what it is"), rows)
    if kept := _memory(out, written):
        fit = "fits" if kept.fits_l1 else "does not fit"
        other = "" if kept.fits_l1 else "; --l1-kb 64 makes two memories of it"
        print_line(
            f"{kept.state_bytes:,} bytes of RAM, which {fit} a GAP8's L1: {L1_FOR_STATE:,} beside "
            f"stacks{other}"
        )
        if kept.far_bytes:
            print_line(
                f"{kept.far_bytes:,} bytes more in a far memory; {kept.traffic_bytes:,} bytes are "
                "copied an image"
            )
        print_line(f"prove the C with: dmrl verify {out}")
