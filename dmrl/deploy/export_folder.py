"""Files of a network that run elsewhere: ONNX, and C for a microcontroller."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

from dmrl.deploy.backends import to_network_input
from dmrl.deploy.c import CORE_STACKS_BYTES, write_c
from dmrl.deploy.detector import FLOAT_ONNX_NAME, INT8_ONNX_NAME, is_export_folder
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.store import INTEGER_NAME, load_network
from dmrl.deploy.samples import SAMPLES_NAME, load_samples
from dmrl.errors import ModelError, optional_imports
from dmrl.learn.pretrained import DESCRIPTION_NAME


@dataclass(frozen=True, slots=True)
class Written:
    """Name, content and size of a file."""

    name: str
    what: str
    size_bytes: int


DECODED_NAMES = {FLOAT_ONNX_NAME: "decoded.onnx", INT8_ONNX_NAME: "decoded.int8.onnx"}
"""Files with the decoding inside, by the file that they are made of."""
CONTENTS = {
    "decoded.onnx": "float ONNX with the decoding: image in, detections out",
    "decoded.int8.onnx": "int8 ONNX with the decoding",
    "README.md": "how to use it: programs for onnxruntime, ROS 2, C and C++",
    FLOAT_ONNX_NAME: "float ONNX: image in, maps out",
    INT8_ONNX_NAME: "int8 ONNX (QDQ): the fast way on a computer, with onnxruntime",
    INTEGER_NAME: "the int8 network as arrays: what dmrl verify compares with",
    SAMPLES_NAME: "images to verify on",
    DESCRIPTION_NAME: "size of the image, outputs, threshold",
    "main.c": "a self-test: make test",
    "Makefile": "builds and runs the self-test",
    "pilot.c": "C that follows a drone by the detections",
    "pilot.h": "its header",
    "provenance.json": "the origin of the network",
}
"""Content of each file, by its name."""


def write_export(model: Path, folder: Path, *, bayer: bool, l1_kb: int | None) -> bool:
    """Write a model into a folder; return whether it has an int8 network, and so C.

    Parameters
    ----------
    model
        Quantised model; or a run folder, .safetensors or Keras .h5: then float ONNX alone.
    folder
        Folder to write the files into.
    bayer
        Let the C take raw colour mosaics.
    l1_kb
        Kilobytes of the near memory that the C works in. None: there is one memory.

    Raises
    ------
    ModelError
        If the model cannot be used, or has a layer that cannot be carried.
    MissingExtra
        If torch or onnx is not installed.
    """
    with optional_imports("train", "dmrl export"):
        from dmrl.deploy.onnx.float_model import float_onnx_of  # noqa: PLC0415 - an extra
        from dmrl.learn.inference import loaded_model  # noqa: PLC0415 - an extra
    trained = loaded_model.load_model(model)
    network = load_network(model) if (model / INTEGER_NAME).is_file() else None
    grey = network is not None and network.channels == 1
    (folder / FLOAT_ONNX_NAME).write_bytes(float_onnx_of(trained, grey=grey))
    if network is not None:
        near_bytes = None if l1_kb is None else l1_kb * 1024 - CORE_STACKS_BYTES
        _write_int8(network, model, folder)
        images = [to_network_input(network, image) for image in load_samples(model)]
        write_c(network, folder, images, bayer=bayer, near_bytes=near_bytes)
    described = loaded_model.describe(trained) | {"channels": 1 if grey else 3}
    text = json.dumps(described, indent=1) + "\n"
    (folder / DESCRIPTION_NAME).write_text(text, encoding="utf-8")
    return network is not None


def write_decoded(folder: Path) -> None:
    """Write the ONNX files of an export once more, with the decoding inside.

    Raises
    ------
    MissingExtra
        If onnx is not installed.
    """
    from dmrl.deploy.onnx.decoded_output import add_decoding  # noqa: PLC0415 - an extra

    described = json.loads((folder / DESCRIPTION_NAME).read_text(encoding="utf-8"))
    for name, decoded in DECODED_NAMES.items():
        if (folder / name).is_file():
            model = add_decoding((folder / name).read_bytes(), described["stride_px"])
            (folder / decoded).write_bytes(model)


def refuse_export(model: Path) -> None:
    """Raise ModelError if a model is an export folder already."""
    if is_export_folder(model):
        raise ModelError(f"{model} is an export folder already. Give the model it was made from")


def _write_int8(network: IntegerNetwork, model: Path, folder: Path) -> None:
    from dmrl.deploy.onnx.graph_writer import int8_onnx  # noqa: PLC0415 - an extra

    (folder / INT8_ONNX_NAME).write_bytes(int8_onnx(network))
    for name in (INTEGER_NAME, SAMPLES_NAME):
        shutil.copyfile(model / name, folder / name)


def list_files(folder: Path) -> list[Written]:
    """Return the files of an export folder, by name."""
    return [_describe_file(path) for path in sorted(folder.iterdir())]


def _describe_file(path: Path) -> Written:
    kinds = {".c": "C of the network: your program needs it and its header", ".h": "its header"}
    other = (
        "images of the self-test" if path.stem.endswith("_vectors") else kinds.get(path.suffix, "")
    )
    return Written(path.name, CONTENTS.get(path.name, other), path.stat().st_size)
