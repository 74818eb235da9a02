"""Read arrays of an HDF5 file of a stranger in a child process."""

import io
import json
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.errors import MissingExtra, ModelError, SettingError
from dmrl.guards import limits
from dmrl.guards.cage import run_caged


def read_arrays(
    path: Path, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray[np.float32]]:
    """Read the arrays of these names and shapes.

    Parameters
    ----------
    path
        HDF5 file; its arrays may lie in the group ``model_weights``.
    shapes
        Shapes by ``group/name``.

    Raises
    ------
    ModelError
        If the file cannot be read, an array is missing or has another shape, or it takes too
        much memory or time.
    MissingExtra
        If h5py is not installed.
    """
    if find_spec("h5py") is None:
        raise MissingExtra("h5py", "keras", f"{path.name}")
    if path.stat().st_size > limits.MEMORY_BYTES:
        raise ModelError(f"{path} is larger than any weights that dmrl uses. Check it")
    request = json.dumps([str(path), shapes]).encode() + b"\n" + path.read_bytes()
    try:
        answer = run_caged(f"{__name__}:read_request", request, str(path))
    except SettingError as e:
        raise ModelError(str(e)) from None
    with np.load(io.BytesIO(answer)) as arrays:
        return dict(arrays)


def read_request(request: bytes) -> bytes:
    """Read arrays in the child process; return them as an .npz file."""
    import h5py  # noqa: PLC0415 - only the caged process needs it

    head, _, data = request.partition(b"\n")
    path, shapes = json.loads(head)
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            inner = file.get("model_weights", getlink=True)
            group = file["model_weights"] if isinstance(inner, h5py.HardLink) else file
            arrays = {n: _read_array(path, group, n, *shape) for n, shape in shapes.items()}
    except (OSError, RuntimeError, ValueError, TypeError, LookupError, MemoryError) as e:
        why = " ".join(str(e).split())
        raise ModelError(f"{path} cannot be read: {why}. Download it again") from None
    out = io.BytesIO()
    np.savez(out, **arrays)  # type: ignore[arg-type]  # one of its flags is a keyword too
    return out.getvalue()


def _read_array(path: str, group: Any, name: str, *wanted: int) -> NDArray[np.float32]:
    import h5py  # noqa: PLC0415 - only the caged process needs it

    layer, variable = name.split("/")
    found = group
    for part in (layer, layer, f"{variable}:0"):
        # A soft or external link could lead to any other file of this machine.
        link = found.get(part, getlink=True) if isinstance(found, h5py.Group) else None
        found = found[part] if isinstance(link, h5py.HardLink) else None
    if not isinstance(found, h5py.Dataset) or found.external or found.is_virtual:
        raise ModelError(f"{path} has no {name}. Give weights of locanet")
    if found.shape != wanted:
        raise ModelError(
            f"{path}: {name} has shape {found.shape}, locanet needs {wanted}. "
            "Give weights of locanet"
        )
    return np.asarray(found, dtype=np.float32)
