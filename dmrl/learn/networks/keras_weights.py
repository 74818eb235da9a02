"""Import of published Keras weights (.h5) for ``locanet``.

Keras stores a kernel as (height, width, in, out), torch as (out, in, height, width). At stride 1,
'same' padding is symmetric, so a 3x3 kernel needs padding 1 in torch.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dmrl.learn.networks.architectures import LocaNet
from dmrl.learn.networks.hdf5_arrays import read_arrays

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
    variables = _map_variables()
    shapes = {name: tuple(value.shape) for name, value in LocaNet().state_dict().items()}
    # Keras has the channels last.
    wanted = {of: (*shapes[name][2:], *shapes[name][1::-1]) for name, of in variables.items()}
    arrays = read_arrays(path, wanted)
    return {
        name: torch.from_numpy(np.ascontiguousarray(arrays[of].transpose(3, 2, 0, 1)))
        if arrays[of].ndim == 4
        else torch.from_numpy(arrays[of])
        for name, of in variables.items()
    }


def _map_variables() -> dict[str, str]:
    """Map the name of every torch tensor to ``layer/variable`` of the Keras file."""
    blocks = len(LocaNet.widths)
    numbered = [f"_{i}" if i else "" for i in range(blocks + 1)]
    places = {f"convs.{i}.weight": f"conv2d{numbered[i]}/kernel" for i in range(blocks)}
    for i in range(blocks):
        for keras, ours in BATCH_NORM_VARIABLES.items():
            places[f"norms.{i}.{ours}"] = f"batch_normalization{numbered[i]}/{keras}"
    places["head.weight"] = f"conv2d{numbered[blocks]}/kernel"
    places["head.bias"] = f"conv2d{numbered[blocks]}/bias"
    return places
