"""Test vectors of the self-test: images and the reference output for them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.bayer_input import demosaic, mosaic
from dmrl.deploy.c.templating import array, fill
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.reference import decode, run

Image = NDArray[np.uint8]
MOST = 5
"""Maximum number of detections of a vector."""


def vectors(
    network: IntegerNetwork, images: Sequence[Image], names: dict[str, str], *, bayer: bool
) -> str:
    """Generate the header with the vectors: one of noise, and the first of ``images``."""
    if not bayer:
        shape: tuple[int, ...] = (network.height_px, network.width_px, network.channels)
        raws = [noise(shape), *images[:1]]
        seen = raws
    else:
        raws = [noise((network.height_px, network.width_px)), *map(mosaic, images[:1])]
        seen = [demosaic(raw, channels=network.channels) for raw in raws]
    rows = "".join(_vector(network, image, ("0", "picture")[k]) for k, image in enumerate(seen))
    pictures = "".join(array("uint8_t", "picture", raw) for raw in raws[1:])
    return fill("vectors.h", **names, bayer=int(bayer), most=MOST, pictures=pictures, rows=rows)


def noise(shape: tuple[int, ...]) -> Image:
    """Generate the noise image of the self-test, with a linear congruential generator."""
    state, values = 1, bytearray(int(np.prod(shape)))
    for k in range(len(values)):
        state = (state * 1664525 + 1013904223) % 2**32
        values[k] = state >> 24
    return np.frombuffer(bytes(values), np.uint8).reshape(shape)


def checksum(grids: Sequence[NDArray[np.int8]]) -> int:
    """Compute the 32-bit FNV-1a hash of the bytes of all grids."""
    state = 2166136261
    for byte in b"".join(grid.tobytes() for grid in grids):
        state = (state ^ byte) * 16777619 % 2**32
    return state


def _vector(network: IntegerNetwork, image: Image, name: str) -> str:
    """Generate the C initialiser of one vector."""
    grids = run(network, image)
    found = [
        f"{{{d.u_q4}, {d.v_q4}, {d.depth_mm}, {d.confidence}, 0}}"
        for d in decode(network, grids, MOST)
    ]
    body = ", ".join(found) or "{0, 0, 0, 0, 0}"
    return f"    {{{name}, {checksum(list(grids.values()))}u, {len(found)}, {{{body}}}}},\n"
