"""Hard negatives: images without a robot, in the order in which a network believes in one.

Of places that look like nothing, one image teaches as much as a thousand; what is worth seeing
again is what was taken for a robot (Sung and Poggio 1998, Shrivastava et al. 2016).
"""

import numpy as np
from numpy.typing import NDArray

from dmrl.learn.data.batches import Examples, U, gathered
from dmrl.learn.inference.loaded_model import grids_of
from dmrl.learn.networks.architectures import Network

LEAST = 0.05
"""Confidence that every image is taken to have at least, so that none is forgotten."""
BATCH = 32


def mined(
    network: Network, examples: Examples, shares: NDArray[np.float64] | None, hard_share: float
) -> NDArray[np.float64] | None:
    """How often each image shall come in the next epoch, 1 on average.

    Images without a robot make up ``hard_share`` of it, each in proportion to the square of the
    greatest confidence that the network has in it; the others keep their proportions. An image
    that has no share gets none.

    Parameters
    ----------
    network
        As it stands; left in the mode that it is in.
    examples
        Training images.
    shares
        (N,) of the images so far. None: 1 for each.
    hard_share
        Share of the epoch, 0 to 1.
    """
    before = np.ones(len(examples)) if shares is None else shares
    empty = empties(examples)
    wanted = empty & (before > 0)  # what has no share is not to be learned from
    if not wanted.any() or not before[~empty].sum():
        return shares
    weight = np.maximum(beliefs(network, examples, np.flatnonzero(wanted)), LEAST) ** 2
    out = before.copy()
    out[wanted] = hard_share * weight / weight.sum()
    out[~empty] *= (1 - hard_share) / before[~empty].sum()
    return np.asarray(out * len(examples))


def empties(examples: Examples) -> NDArray[np.bool_]:
    """(N,) which images are labelled to hold no robot."""
    return np.asarray(np.isnan(examples.robots[..., U]).all(axis=1))


def beliefs(network: Network, examples: Examples, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
    """(len(chosen),) the greatest confidence in each of the chosen images, 0 to 1."""
    training = network.training
    network.eval()
    try:
        found = [
            grids_of(network, gathered(examples, chosen[start : start + BATCH]).images)
            for start in range(0, len(chosen), BATCH)
        ]
    finally:
        network.train(training)
    parts = [grids.confidence.reshape(len(grids.confidence), -1).max(axis=1) for grids in found]
    return np.concatenate(parts).astype(np.float64)
