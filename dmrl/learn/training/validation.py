"""Validation: loss and detection metrics of a network on held-out images."""

import numpy as np
import torch
from numpy.typing import NDArray

from dmrl.geometry.frames import is_inside
from dmrl.learn.data.batches import DEPTH, SIGMA_DEPTH, SIGMA_U, ExampleSet, U, V, iter_batches
from dmrl.learn.inference import detection_metrics
from dmrl.learn.inference.decode_grids import decode
from dmrl.learn.inference.loaded_model import predict_grids
from dmrl.learn.inference.matching import Points
from dmrl.learn.networks.architectures import Network
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.train_step import compute_losses

VALIDATION_METRICS = ("within_20_px", "median_px", "depth_mae_m", "ap_16_px")
"""Metrics of `detection_metrics` that are logged during a training."""
ALL_DEPTHS_M = (0.0, np.inf)
"""Depth band of all labels, metres."""
SIGMAS_OF_HIT = 2.0
"""Standard deviations of a label by which a hit may be off, beside the radius."""
SCORED_IMAGES = 16
"""Images of a batch that is scored."""


def validate(network: Network, examples: ExampleSet, settings: TrainConfig) -> dict[str, float]:
    """Compute loss and metrics on held-out images; each name begins with validation.

    Parameters
    ----------
    network
        Network in evaluation mode.
    examples
        Held-out images, without augmentation.
    settings
        Training configuration, for losses and batch size.
    """
    total = 0.0
    with torch.inference_mode():
        for batch in iter_batches(examples, settings.batch_size):
            total += float(compute_losses(network, batch, settings).sum()) * len(batch.images)
    scored = score_examples(network, examples)
    found = detection_metrics.compute_metrics(
        scored, ALL_DEPTHS_M, 0.5, np.ones((1, len(examples)))
    )
    watched = {f"validation_{name}": float(found[name][0]) for name in VALIDATION_METRICS}
    return {"validation_loss": total / len(examples), **watched}


def score_examples(network: Network, examples: ExampleSet) -> detection_metrics.ScoredDetections:
    """Detect robots in images and match the detections with the labels.

    A hit may be off by twice the label's standard deviation, beside the radius of the metric.
    """
    parts = []
    for batch in iter_batches(examples, SCORED_IMAGES):
        found = decode(*predict_grids(network, batch.images), stride_px=network.stride_px)
        parts.append(Points.from_detections(found))
    first = np.arange(0, len(examples), SCORED_IMAGES)
    sigma_px = examples.robots[..., SIGMA_U : SIGMA_U + 2].max(axis=-1)[_find_visible(examples)]
    return detection_metrics.score_detections(
        len(examples),
        select_visible_labels(examples),
        Points.concatenate(parts, first),
        SIGMAS_OF_HIT * np.nan_to_num(sigma_px).astype(float),
    )


def select_visible_labels(examples: ExampleSet) -> Points:
    """Return the labels of robots whose centres are inside the images."""
    inside = _find_visible(examples)
    robots = examples.robots.astype(np.float64)
    image, _ = np.nonzero(inside)
    depth_m = np.where(np.isinf(robots[..., SIGMA_DEPTH]), np.nan, robots[..., DEPTH])[inside]
    return Points(image, robots[inside, U], robots[inside, V], depth_m, np.ones(len(image)))


def _find_visible(examples: ExampleSet) -> NDArray[np.bool_]:
    """Return (N, K) whether the centre of each robot is inside its image."""
    height_px, width_px, _ = examples.image_shape
    return is_inside(examples.robots[..., [U, V]], width_px, height_px)
