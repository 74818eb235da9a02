"""Import of published Keras weights (.h5) for ``locanet``.

Keras stores a kernel as (height, width, in, out), torch as (out, in, height, width). At stride 1,
'same' padding is symmetric, so a 3x3 kernel needs padding 1 in torch.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dmrl.errors import MissingExtra, ModelError
from dmrl.guards.memory import MemoryLimit
from dmrl.learn.networks.architectures import LocaNet

try:
    import h5py
except ImportError:
    h5py = None

BATCH_NORM_VARIABLES = {
    "gamma": "weight",
    "beta": "bias",
    "moving_mean": "running_mean",
    "moving_variance": "running_var",
}


def load_keras_weights(path: Path) -> dict[str, Tensor]:
    """Read the weights of ``locanet`` from a Keras file, keyed by torch name.

    Parameters
    ----------
    path
        A saved model, or weights only, with layers conv2d, conv2d_1 .. conv2d_4 and
        batch_normalization .. batch_normalization_3.

    Raises
    ------
    ModelError
        If a layer is missing or has another shape; the message contains its name and both shapes.
    MissingExtra
        If h5py is not installed.
    """
    if h5py is None:
        raise MissingExtra("h5py", "keras", f"{path.name}")
    try:
        with MemoryLimit(path.stat().st_size), h5py.File(path, "r") as file:
            inner = file.get("model_weights", getlink=True)
            group = file["model_weights"] if isinstance(inner, h5py.HardLink) else file
            shapes = {name: value.shape for name, value in LocaNet().state_dict().items()}
            return {
                name: _load_variable(path, group, *where, shapes[name])
                for name, where in _map_variables().items()
            }
    except (OSError, RuntimeError, ValueError, TypeError, LookupError, MemoryError) as e:
        why = " ".join(str(e).split())
        raise ModelError(f"{path} cannot be read: {why}. Download it again") from None


def _map_variables() -> dict[str, tuple[str, str]]:
    """Map the name of every torch tensor to its layer and variable in the Keras file."""
    blocks = len(LocaNet.widths)
    numbered = [f"_{i}" if i else "" for i in range(blocks + 1)]
    places = {f"convs.{i}.weight": (f"conv2d{numbered[i]}", "kernel") for i in range(blocks)}
    for i in range(blocks):
        for keras, ours in BATCH_NORM_VARIABLES.items():
            places[f"norms.{i}.{ours}"] = (f"batch_normalization{numbered[i]}", keras)
    places["head.weight"] = (f"conv2d{numbered[blocks]}", "kernel")
    places["head.bias"] = (f"conv2d{numbered[blocks]}", "bias")
    return places


def _load_variable(
    path: Path, group: "h5py.Group", layer: str, variable: str, ours: tuple[int, ...]
) -> Tensor:
    found: h5py.Group | h5py.Dataset | None = group
    for part in (layer, layer, f"{variable}:0"):
        # A soft or external link could lead to any other file of this machine.
        own = isinstance(found, h5py.Group) and isinstance(
            found.get(part, getlink=True), h5py.HardLink
        )
        found = found[part] if found is not None and own else None
    if not isinstance(found, h5py.Dataset) or found.external or found.is_virtual:
        raise ModelError(f"{path} has no {layer}/{variable}. Give weights of locanet")
    wanted, shape = (*ours[2:], *ours[1::-1]), found.shape  # Keras has the channels last
    if shape != wanted:
        raise ModelError(
            f"{path}: {layer}/{variable} has shape {shape}, locanet needs {wanted}. "
            "Give weights of locanet"
        )
    values = np.asarray(found, dtype=np.float32)
    if values.ndim == 4:
        values = values.transpose(3, 2, 0, 1)
    return torch.from_numpy(np.ascontiguousarray(values))
