"""Portable C99 of an int8 network: source and header, self-test, Makefile and README."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.c.network_source import generate_source
from dmrl.deploy.c.self_test import MAX_DETECTIONS, generate_vectors
from dmrl.deploy.c.templating import c_name, fill_template, template_values
from dmrl.deploy.int8.network import IntegerNetwork

__all__ = ["c_name", "write_c"]

CORE_STACKS_BYTES = 8 * 1024
"""Bytes of a GAP8's L1 for the stacks of eight cores, one kilobyte each."""
MAX_L1_STATE_BYTES = 64 * 1024 - CORE_STACKS_BYTES
"""Bytes of a GAP8's L1 available for the state."""


def write_c(
    network: IntegerNetwork,
    folder: Path,
    images: Sequence[NDArray[np.uint8]],
    *,
    bayer: bool = False,
    near_bytes: int | None = None,
) -> list[str]:
    """Write the C of a network into a folder.

    Parameters
    ----------
    network
        The network.
    folder
        An existing folder.
    images
        (height, width, channels) images in the network's format; the first becomes a vector of the
        self-test, in addition to one of noise.
    bayer
        Whether the C takes raw Bayer mosaics by default; a compiler flag overrides it.
    near_bytes
        Bytes of the near memory that the state must fit, see `placement`. None: one memory.

    Returns
    -------
    list[str]
        Names of the files written.

    Raises
    ------
    ModelError
        If the C does not support the network; the message contains the layer's name.
    SettingError
        If the near memory is too small.
    """
    name = c_name(network)
    made = generate_source(network, template_values(network), bayer=bayer, near_bytes=near_bytes)
    values = made.values
    memory = "L1" if values["state_bytes"] <= MAX_L1_STATE_BYTES else "L2"
    files = {
        f"{name}.c": made.code,
        f"{name}.h": made.header,
        f"{name}_vectors.h": generate_vectors(network, images, values, bayer=bayer),
        "main.c": fill_template("main.c", **values, most=MAX_DETECTIONS),
        "Makefile": fill_template("Makefile", **values),
        "README.md": fill_template("README.md", **values, memory=memory),
    }
    for file, text in files.items():
        (folder / file).write_text(text, encoding="utf-8")
    return list(files)
