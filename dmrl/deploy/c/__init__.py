"""Portable C99 of an int8 network: one file and a header, with what checks and explains them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.c.refinement import refinement
from dmrl.deploy.c.source import source
from dmrl.deploy.c.text import c_name, fill, names_of
from dmrl.deploy.c.vectors import MOST, vectors
from dmrl.deploy.integer import IntegerNetwork

__all__ = ["c_name", "write_c"]

L1_FOR_STATE = 64 * 1024 - 8 * 1024
"""Bytes of the GAP8's L1 that a state may take, beside eight cores' stacks of a kilobyte each."""


def write_c(
    network: IntegerNetwork,
    folder: Path,
    images: Sequence[NDArray[np.uint8]],
    *,
    bayer: bool = False,
    refine: bool = False,
) -> list[str]:
    """Write the C of a network into a folder.

    Parameters
    ----------
    network
        What it computes.
    folder
        An existing folder.
    images
        (height, width, channels) images as the network takes them; the first becomes a vector
        of the self-test, beside one of noise.
    bayer
        Whether the C takes raw colour mosaics unless compiler flags say otherwise.
    refine
        Write the C that learns on as well, see `refinement`.

    Returns
    -------
    list[str]
        Names of the files written.

    Raises
    ------
    ModelError
        If the C cannot carry the network; the layer is named.
    """
    names, name = names_of(network), c_name(network)
    made = source(network, names, bayer=bayer, features=refine)
    files = refinement(network, names) if refine else {}
    files |= {
        f"{name}.c": made.code,
        f"{name}.h": made.header,
        f"{name}_vectors.h": vectors(network, images, names, bayer=bayer),
        "main.c": fill("main.c", **names, most=MOST),
        "Makefile": fill("Makefile", **names),
        "README.md": fill(
            "README.md",
            **names,
            state_bytes=made.state_bytes,
            bayer_bytes=made.bayer_bytes,
            constant_bytes=made.constant_bytes,
            stack_bytes=made.stack_bytes,
            input="raw Bayer images" if bayer else "RGB" if network.channels == 3 else "grey",
            macs=f"{network.macs / 1e6:.1f}",
            memory="L1" if made.state_bytes <= L1_FOR_STATE else "L2",
        ),
    }
    for file, text in files.items():
        (folder / file).write_text(text, encoding="utf-8")
    return list(files)
