"""Hard negative mining: images without a robot, sampled by the network's highest confidence.

Easy backgrounds teach little: one image is as good as a thousand. Backgrounds that the network
classifies as robots are worth repeating (Sung and Poggio 1998, Shrivastava et al. 2016).
"""

import numpy as np
from numpy.typing import NDArray

from dmrl.learn.data.batches import ExampleSet, U, collate
from dmrl.learn.inference.loaded_model import predict_grids
from dmrl.learn.networks.architectures import Network

MIN_CONFIDENCE = 0.05
"""Lower bound of an image's confidence when it is weighted, so that every image still appears."""
BATCH_SIZE = 32
"""Images per forward pass."""


def mine_hard_negatives(
    network: Network, examples: ExampleSet, shares: NDArray[np.float64] | None, hard_share: float
) -> NDArray[np.float64] | None:
    """Return how often each image shall appear in the next epoch, 1 on average.

    Images without a robot make up ``hard_share`` of the epoch. Each appears in proportion to the
    square of the network's highest confidence in it. The other images keep their proportions. An
    image of weight 0 keeps weight 0.

    Parameters
    ----------
    network
        Network in its present state; its mode (train or eval) is restored.
    examples
        Training images.
    shares
        (N,) previous weights of the images. None: 1 for each.
    hard_share
        Fraction of the epoch without a robot, 0 to 1.

    Returns
    -------
    NDArray or None
        (N,) weights; ``shares`` itself if there are no images of one of the two kinds.
    """
    before = np.ones(len(examples)) if shares is None else shares
    empty = find_empty_images(examples)
    wanted = empty & (before > 0)  # weight 0: excluded from training
    if not wanted.any() or not before[~empty].sum():
        return shares
    peaks = compute_peak_confidences(network, examples, np.flatnonzero(wanted))
    weight = np.maximum(peaks, MIN_CONFIDENCE) ** 2
    out = before.copy()
    out[wanted] = hard_share * weight / weight.sum()
    out[~empty] *= (1 - hard_share) / before[~empty].sum()
    return np.asarray(out * len(examples))


def find_empty_images(examples: ExampleSet) -> NDArray[np.bool_]:
    """Return (N,) whether each image is labelled as containing no robot."""
    return np.asarray(np.isnan(examples.robots[..., U]).all(axis=1))


def compute_peak_confidences(
    network: Network, examples: ExampleSet, chosen: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return (len(chosen),) the highest confidence in each of the chosen images, 0 to 1."""
    training = network.training
    network.eval()
    try:
        found = [
            predict_grids(network, collate(examples, chosen[start : start + BATCH_SIZE]).images)
            for start in range(0, len(chosen), BATCH_SIZE)
        ]
    finally:
        network.train(training)
    parts = [grids.confidence.reshape(len(grids.confidence), -1).max(axis=1) for grids in found]
    return np.concatenate(parts).astype(np.float64)
