"""Opens a model for one of the backends.

Modules are imported by name on demand: each requires packages that the others do not.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from dmrl.deploy.backend_names import BackendName
from dmrl.deploy.backends import Backend, Images, Int8Backend, build_reference_backend, to_grids
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.quantise import HEAD_OF_CHANNEL
from dmrl.deploy.int8.store import INTEGER_NAME, load_network
from dmrl.deploy.onnx.float_cache import build_float_onnx_once
from dmrl.errors import MissingExtra, ModelError, SettingError, optional_imports
from dmrl.geometry.frames import STRIDE_PX
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.paths import refuse_pipes, require_text_path
from dmrl.learn import pretrained
from dmrl.learn.inference.decode_grids import Grids, require_whole_cells
from dmrl.learn.pretrained import DESCRIPTION_NAME, WEIGHTS_NAME

FLOAT_ONNX_NAME = "model.onnx"
INT8_ONNX_NAME = "model.int8.onnx"
QUANTIZE_HINT = "Make one with: dmrl quantize MODEL DATASET OUT"
RATE_FIELDS = ("min_confidence", "distance_m", "detected", "false_per_image", "slope", "offset")
"""Fields of the rates in the description of a model."""
BACKEND_PACKAGES: dict[BackendName, tuple[str, ...]] = {
    "torch": ("torch", "numpy"),
    "onnx": ("onnxruntime", "numpy"),
    "onnx-int8": ("onnxruntime", "numpy"),
    "integer": ("numpy",),
    "c": ("numpy",),
    "riscv32": ("numpy",),
}
"""Packages whose version can change the output of a backend."""


@dataclass(frozen=True, slots=True, eq=False)
class Detector:
    """Function from images to grids, with its properties.

    Parameters
    ----------
    name
        Name of the model.
    grids
        Function from (N, height, width, 3) RGB images, or a list of N, to output grids.
    stride_px
        Side of a grid cell.
    threshold
        Confidence from which a detection is reported, 0 to 1.
    size_px
        Required width and height of the images; None: any whole number of cells.
    file
        The file that alone determines the result; None: the whole model does.
    """

    name: str
    grids: Callable[[Images], Grids]
    stride_px: int
    threshold: float
    size_px: tuple[int, int] | None
    file: Path | None = None

    def require_size(self, width_px: int, height_px: int, what: object) -> None:
        """Raise SettingError unless the detector accepts images of this size.

        Raises
        ------
        SettingError
            If it requires another size or a whole number of cells.
        """
        if self.size_px is None:
            require_whole_cells((width_px, height_px), self.stride_px, self.name, what)
        if self.size_px not in (None, (width_px, height_px)):
            taken, flags = "{} x {}", "--width-px {} --height-px {}"
            taken, flags = (words.format(*self.size_px or ()) for words in (taken, flags))
            raise SettingError(
                f"{what}: images of {width_px} x {height_px} px, {self.name} takes only {taken}. "
                f"Convert them again: dmrl convert ... {flags}, or quantise the model for images "
                "of this size"
            )


def open_detector(model: Path, backend: BackendName) -> Detector:
    """Open a model with a backend.

    Parameters
    ----------
    model
        Run folder, .safetensors, Keras .h5, quantised model or export folder.
    backend
        "torch" and "onnx" are float. "integer" (NumPy), "onnx-int8", "c" and "riscv32" (the C,
        emulated) are int8 and require a quantised model or an export folder.

    Raises
    ------
    ModelError
        If the model cannot be used, or not with this backend.
    MissingExtra
        If the backend requires a package that is not installed.
    SettingError
        If there is no such backend.
    """
    if not model.exists():
        raise ModelError(
            f"no model {model}. Give a run folder, a Keras .h5, an export folder, or the name of "
            f"one that ships with dmrl: {', '.join(pretrained.list_pretrained())}"
        )
    require_text_path(model)
    refuse_pipes(model)
    if model.suffix == ".onnx":
        return _open_submitted(model, backend)
    if backend not in OPENERS:
        raise SettingError(f"no backend {backend}. There are: {', '.join(OPENERS)}")
    return OPENERS[backend](model, backend)


def select_fastest_backend(model: Path, size_px: tuple[int, int]) -> BackendName:
    """Return the fastest installed float backend that supports all outputs of a model.

    Parameters
    ----------
    model
        As in `open_detector`.
    size_px
        Width and height of the images.
    """
    if model.suffix == ".onnx":
        return "onnx"
    try:
        import_module("dmrl.deploy.onnx.runtime")
        if is_export_folder(model):
            return "onnx"
        said = _build_float_onnx(model)[1]
    except (MissingExtra, ModelError):
        return "torch"  # which then reports the error
    told = set(said["outputs"]) <= set(HEAD_OF_CHANNEL)
    return "onnx" if told and size_px == (said["width_px"], said["height_px"]) else "torch"


def is_export_folder(model: Path) -> bool:
    """Return whether a folder holds a float network for other programs, and no weights."""
    return (model / FLOAT_ONNX_NAME).is_file() and not (model / WEIGHTS_NAME).is_file()


def _build_float_onnx(model: Path) -> tuple[bytes, dict[str, Any]]:
    """Return the float ONNX of a model that is no export folder, and its description."""
    grey = (model / INTEGER_NAME).is_file() and load_network(model).channels == 1
    return build_float_onnx_once(model, grey=grey)


def _open_torch(model: Path, _backend: BackendName) -> Detector:
    if is_export_folder(model):
        raise ModelError(
            f"{model} is an export folder, which torch cannot run. Give --backend onnx, or the "
            "model that was exported"
        )
    learned = _import_optional(
        "dmrl.learn.inference.loaded_model", "train", "--backend torch"
    ).load_model(model)
    file = model / WEIGHTS_NAME if model.is_dir() else None
    return Detector(
        model.name,
        lambda images: learned.grids(np.asarray(images)),
        learned.network.stride_px,
        learned.threshold,
        size_px=None,
        file=file,
    )


def _open_onnx(model: Path, _backend: BackendName) -> Detector:
    room = _import_optional("dmrl.deploy.onnx.runtime", "deploy", "--backend onnx")
    file = model / FLOAT_ONNX_NAME
    if file.is_file():
        runs = room.OnnxRun(file, file)
        stride_px, threshold = _parse_description(model / DESCRIPTION_NAME)
    else:
        written, said = _build_float_onnx(model)
        runs = room.OnnxRun(written, model)
        stride_px, threshold = said["stride_px"], said["threshold"]
        file = model / WEIGHTS_NAME
    size_px = (runs.width_px, runs.height_px)
    decides = file if file.is_file() else None
    return Detector(model.name, _grids_function(runs), stride_px, threshold, size_px, decides)


def _open_submitted(model: Path, backend: BackendName) -> Detector:
    """Open an ONNX file of another program; only onnxruntime can run it."""
    if backend != "onnx":
        raise ModelError(
            f"{model} is an ONNX file, which {backend} cannot run. Give --backend onnx"
        )
    room = _import_optional("dmrl.deploy.onnx.submitted", "deploy", "an ONNX file")
    network = room.SubmittedNetwork(model)
    return Detector(model.stem, network, STRIDE_PX, network.threshold, network.size_px, model)


def _open_onnx_int8(model: Path, backend: BackendName) -> Detector:
    room = _import_optional("dmrl.deploy.onnx.runtime", "deploy", "--backend onnx-int8")
    network = _load_int8_network(model, backend)
    file = model / INT8_ONNX_NAME
    if file.is_file():
        return _build_detector(model, network, room.OnnxRun(file, file), file)
    written = _import_optional(
        "dmrl.deploy.onnx.graph_writer", "deploy", "--backend onnx-int8"
    ).int8_onnx(network)
    return _build_detector(model, network, room.OnnxRun(written, model), _integer_path(model))


def _open_integer(model: Path, backend: BackendName) -> Detector:
    network = _load_int8_network(model, backend)
    return _build_detector(model, network, build_reference_backend(network), _integer_path(model))


def _open_c(model: Path, backend: BackendName) -> Detector:
    network = _load_int8_network(model, backend)
    # With their template engine, these are not for the backends that start fast.
    from dmrl.deploy.c import c_name  # noqa: PLC0415
    from dmrl.deploy.c.run.compiled import RISCV32, CompiledNetwork, EmulatedNetwork  # noqa: PLC0415

    source = model / f"{c_name(network)}.c"
    exported = source.is_file()
    kind = EmulatedNetwork if backend == RISCV32 else CompiledNetwork
    runs = Int8Backend(network, kind(network, model if exported else None).run)
    return _build_detector(model, network, runs, source if exported else _integer_path(model))


def _load_int8_network(model: Path, backend: BackendName) -> IntegerNetwork:
    if model.is_file() and model.suffix != ".npz":
        raise ModelError(f"{model} is float, --backend {backend} is int8. {QUANTIZE_HINT}")
    if model.is_dir() and not (model / INTEGER_NAME).is_file():
        raise ModelError(
            f"{model} holds no int8 network, as --backend {backend} needs. {QUANTIZE_HINT}"
        )
    return load_network(model)


def _integer_path(model: Path) -> Path:
    return model / INTEGER_NAME if model.is_dir() else model


def _build_detector(model: Path, network: IntegerNetwork, runs: Backend, file: Path) -> Detector:
    size_px = (network.width_px, network.height_px)
    return Detector(
        model.name, _grids_function(runs), network.stride_px, network.threshold, size_px, file
    )


def _grids_function(runs: Backend) -> Callable[[Images], Grids]:
    return lambda images: to_grids(runs.outputs(images))


def _parse_description(file: Path) -> tuple[int, float]:
    """Read stride and threshold from the description of an export folder."""
    try:
        said = parse_json(file.read_text(encoding="utf-8"))
        stride_px, threshold = int(said["stride_px"]), float(said["threshold"])
        if stride_px < 1 or not math.isfinite(threshold):
            raise ValueError(f"a stride of {stride_px} px, a threshold of {threshold}")
        return stride_px, threshold
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise ModelError(f"{file} is damaged: {e}. Export the model again") from None


def read_rates(model: Path) -> dict[str, Any] | None:
    """Read the rates of a model from the description beside its weights; None without them.

    They are the fields of a DetectorRates message: detected peers by distance, false alarms, and
    the likelihood ratio of a confidence. Quantisation is taken to keep them.

    Raises
    ------
    ModelError
        If they are damaged.
    """
    said, file = _read_description(model)
    if (found := said.get("rates")) is None:
        return None
    try:
        rates = {name: np.array(found[name], float) for name in RATE_FIELDS}
        lengths = {rates[name].shape for name in ("distance_m", "detected")}
        if not all(np.isfinite(v).all() for v in rates.values()) or len(lengths) > 1:
            raise ValueError(f"rates {str(found)[:60]}")
        return {name: value.tolist() for name, value in rates.items()}
    except (ValueError, KeyError, TypeError) as e:
        raise ModelError(f"{file} is damaged: {e}. Train or export the model again") from None


def read_focal_lengths(model: Path) -> list[float]:
    """Read the focal lengths, in pixels, that a model was trained with; empty if unknown.

    Raises
    ------
    ModelError
        If they are damaged.
    """
    said, file = _read_description(model)
    try:
        focal_px = [float(value) for value in said.get("focal_px", ())]
        if not all(0 < value < np.inf for value in focal_px):
            raise ValueError(f"focal_px {focal_px}")
        return focal_px
    except (ValueError, TypeError) as e:
        raise ModelError(f"{file} is damaged: {e}. Train or export the model again") from None


def _read_description(model: Path) -> tuple[dict[str, Any], Path]:
    """Return the description beside the weights of a model, empty without one, and its file."""
    file = model / DESCRIPTION_NAME if model.is_dir() else model.with_suffix(".json")
    if not file.is_file() or (model.is_file() and model.suffix != ".safetensors"):
        return {}, file
    try:
        said = parse_json(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as e:
        raise ModelError(f"{file} is damaged: {e}. Train or export the model again") from None
    if not isinstance(said, dict):
        raise ModelError(f"{file} is damaged: no description. Train or export the model again")
    return said, file


def _import_optional(name: str, extra: str, what: str) -> ModuleType:
    with optional_imports(extra, what):
        return import_module(name)


OPENERS: dict[BackendName, Callable[[Path, BackendName], Detector]] = {
    "torch": _open_torch,
    "onnx": _open_onnx,
    "onnx-int8": _open_onnx_int8,
    "integer": _open_integer,
    "c": _open_c,
    "riscv32": _open_c,
}
