"""Integer networks on disk: one .npz of arrays and a JSON description, without pickle."""

import json
import math
import zipfile
import zlib
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.int8.layers import Add, AnyLayer, Conv, MaxPool
from dmrl.deploy.int8.network import HEAD_NAMES, Head, IntegerNetwork
from dmrl.errors import ModelError
from dmrl.guards.bounded_parsing import load_npz, parse_json
from dmrl.guards.paths import refuse_pipes

INTEGER_NAME = "integer.npz"
"""Name of the file in a quantised model and in an export folder."""
FORMAT = 3
LAYER_CLASSES: dict[str, type[AnyLayer]] = {kind.kind: kind for kind in (Conv, MaxPool, Add)}
PLAIN_FIELDS = (
    *("name", "architecture", "channels", "height_px", "width_px", "stride_px"),
    "threshold",
)

CORRUPTION_ERRORS = (
    *(TypeError, ValueError, LookupError, ArithmeticError, AttributeError, RecursionError),
    *(OSError, EOFError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error),
)
"""Errors from reading an untrusted file. zipfile raises RuntimeError for an encrypted file and
NotImplementedError for an unsupported compression."""

Arrays = dict[str, NDArray[Any]]
Part = TypeVar("Part")


def save_network(network: IntegerNetwork, path: Path) -> None:
    """Write a network; equal networks give equal bytes."""
    arrays: Arrays = {}
    layers = [
        {"kind": layer.kind, **_pack_part(layer, f"layer{k}", arrays)}
        for k, layer in enumerate(network.layers)
    ]
    heads = {name: _pack_part(head, name, arrays) for name, head in network.heads.items()}
    plain = {name: getattr(network, name) for name in PLAIN_FIELDS}
    said = {"format": FORMAT, **plain, "layers": layers, "heads": heads}
    text = np.frombuffer(json.dumps(said).encode(), np.uint8)
    np.savez_compressed(path, allow_pickle=False, description=text, **arrays)


def _pack_part(part: AnyLayer | Head, prefix: str, arrays: Arrays) -> dict[str, Any]:
    """Return the plain fields of a part and add its arrays to ``arrays``."""
    plain = {}
    for field in fields(part):
        value = getattr(part, field.name)
        if isinstance(value, np.ndarray):
            arrays[f"{prefix}.{field.name}"] = value
        else:
            plain[field.name] = value
    return plain


def load_network(path: Path) -> IntegerNetwork:
    """Load a network from a file written by `save_network`.

    Parameters
    ----------
    path
        The file, or a folder that contains one: a quantised model or an export folder.

    Raises
    ------
    ModelError
        If there is none, it is damaged, or an invariant is violated.
    """
    refuse_pipes(path)
    file = path / INTEGER_NAME if path.is_dir() else path
    if not file.is_file():
        missing = f"{file.name} in {path}" if path.is_dir() else str(path)
        raise ModelError(f"no {missing}. Make one with: dmrl quantize, then dmrl export")
    try:
        arrays = load_npz(file)
        said = parse_json(arrays.pop("description").tobytes())
        if said["format"] != FORMAT:
            raise ModelError(
                f"{file} has format {said['format']}, this dmrl reads {FORMAT}. Quantise the "
                "model again with this dmrl: dmrl quantize"
            )
        return _build_network(said, arrays)
    except CORRUPTION_ERRORS as e:
        raise ModelError(f"{file} is damaged: {e!r:.200}. Quantise the model again") from None


def _build_network(said: dict[str, Any], arrays: Arrays) -> IntegerNetwork:
    layers = tuple(
        _check_types(LAYER_CLASSES[layer.pop("kind")](**_unpack_part(layer, f"layer{k}", arrays)))
        for k, layer in enumerate(said["layers"])
    )
    heads = {
        name: _check_types(Head(**_unpack_part(head, name, arrays)))
        for name, head in said["heads"].items()
        if name in HEAD_NAMES
    }
    fields: dict[str, Any] = {name: said[name] for name in PLAIN_FIELDS} | heads
    return _check_types(IntegerNetwork(layers=layers, **fields))


def _unpack_part(plain: dict[str, Any], prefix: str, arrays: Arrays) -> dict[str, Any]:
    own = {
        name.removeprefix(f"{prefix}."): value
        for name, value in arrays.items()
        if name.startswith(f"{prefix}.")
    }
    tuples = {name: tuple(v) if isinstance(v, list) else v for name, v in plain.items()}
    return {**tuples, **own}


def _check_types(part: Part) -> Part:
    """Return the part if its fields have their declared types; they become numbers and names in C.

    Raises
    ------
    TypeError
        If one does not.
    """
    for field, kind in get_type_hints(type(part)).items():
        value = getattr(part, field)
        if field not in ("kind", "layers", *HEAD_NAMES) and not _has_type(value, kind):
            raise TypeError(f"{field} is {str(value)[:40]!r}")
    return part


def _has_type(value: Any, kind: Any) -> bool:
    if get_origin(kind) is np.ndarray:
        wanted = get_args(get_args(kind)[1])[0]
        return isinstance(value, np.ndarray) and value.dtype == wanted
    if get_origin(kind) is tuple:
        whole = isinstance(value, tuple) and all(type(v) is int for v in value)
        return whole and len(value) == len(get_args(kind))
    if kind is float:
        return type(value) in (int, float) and math.isfinite(value)
    return type(value) is kind
