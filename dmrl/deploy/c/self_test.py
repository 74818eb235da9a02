"""Test vectors of the self-test: images and the reference output for them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.deploy.bayer_input import demosaic, to_mosaic
from dmrl.deploy.c.templating import fill_template
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.reference import decode_detections, run_network

Image = NDArray[np.uint8]
MAX_DETECTIONS = 5
"""Maximum number of detections of a vector."""


def generate_vectors(
    network: IntegerNetwork, images: Sequence[Image], values: dict[str, Any], *, bayer: bool
) -> str:
    """Generate the header with the vectors: one of noise, and the first of ``images``."""
    if not bayer:
        shape: tuple[int, ...] = (network.height_px, network.width_px, network.channels)
        raws = [generate_noise(shape), *images[:1]]
        seen = raws
    else:
        raws = [generate_noise((network.height_px, network.width_px)), *map(to_mosaic, images[:1])]
        seen = [demosaic(raw, channels=network.channels) for raw in raws]
    vectors = [_run_vector(network, image) for image in seen]
    return fill_template(
        "vectors.h",
        **values,
        most=MAX_DETECTIONS,
        picture=raws[1] if raws[1:] else None,
        vectors=vectors,
    )


def generate_noise(shape: tuple[int, ...]) -> Image:
    """Generate the noise image of the self-test, with a linear congruential generator."""
    state, values = 1, bytearray(int(np.prod(shape)))
    for k in range(len(values)):
        state = (state * 1664525 + 1013904223) % 2**32
        values[k] = state >> 24
    return np.frombuffer(bytes(values), np.uint8).reshape(shape)


def hash_grids(grids: Sequence[NDArray[np.int8]]) -> int:
    """Compute the 32-bit FNV-1a hash of the bytes of all grids."""
    state = 2166136261
    for byte in b"".join(grid.tobytes() for grid in grids):
        state = (state ^ byte) * 16777619 % 2**32
    return state


def _run_vector(network: IntegerNetwork, image: Image) -> dict[str, Any]:
    """Return the checksum and the detections that the self-test expects for an image."""
    grids = run_network(network, image)
    found = decode_detections(network, grids, MAX_DETECTIONS)
    return {"checksum": hash_grids(list(grids.values())), "found": found}
