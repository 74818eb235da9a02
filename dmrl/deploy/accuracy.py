"""Detections of a backend, and their metrics against labels."""

import numpy as np

from dmrl.deploy.backends import Outputs, to_grids
from dmrl.learn.inference.decode_grids import decode
from dmrl.learn.inference.detection_metrics import compute_band_metrics, score_detections
from dmrl.learn.inference.matching import Points


def decode_points(outputs: Outputs, stride_px: int) -> Points:
    """Decode the detections in N images."""
    return Points.from_detections(decode(*to_grids(outputs), stride_px=stride_px))


def compute_accuracy(
    images: int, labels: Points, detections: Points, threshold: float
) -> dict[str, float | None]:
    """Compute the metrics over all distances; None: not measured.

    ``METRIC_DEFINITIONS`` of `detection_metrics` defines them.
    """
    overall, *_ = compute_band_metrics(
        score_detections(images, labels, detections), threshold=threshold, draws=1
    )
    return {
        name: figure.value if np.isfinite(figure.value) else None
        for name, figure in overall.figures.items()
    }


def compare_peaks(wanted: Outputs, got: Outputs) -> float:
    """Return the fraction of images whose most confident cell is the same in both outputs."""
    best = [
        each["confidence"].reshape(len(each["confidence"]), -1).argmax(1) for each in (wanted, got)
    ]
    return float((best[0] == best[1]).mean())
