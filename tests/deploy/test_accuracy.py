"""Accuracy figures of a backend's detections."""

import numpy as np
import pytest

from dmrl.deploy.accuracy import compare_peaks, compute_accuracy, decode_points
from dmrl.learn.inference.matching import Points


def build_outputs(*best: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return outputs with one confident cell per image and a depth of e metres."""
    logit = np.full((len(best), 4, 5), -4.0)
    for k, cell in enumerate(best):
        logit[k][cell] = 3.0
    return {"confidence": logit, "log_depth": np.ones_like(logit), "depth": np.ones_like(logit)}


def test_peak_agreement_is_the_share_of_equal_best_cells() -> None:
    wanted, got = (
        build_outputs((0, 1), (2, 3), (3, 4), (1, 1)),
        build_outputs((0, 1), (2, 4), (3, 4), (0, 1)),
    )
    assert compare_peaks(wanted, got) == 0.5
    assert compare_peaks(wanted, wanted) == 1.0


def test_int8_detections_are_scored_with_the_common_metrics() -> None:
    found = decode_points(build_outputs((0, 1), (2, 3)), 8)
    sure = found.confidence > 0.5
    assert found.image[sure].tolist() == [0, 1]
    assert (found.u_px[sure].tolist(), found.v_px[sure].tolist()) == ([12, 28], [4, 20])
    assert found.depth_m[sure] == pytest.approx(np.e)
    ones = np.ones(2)
    labels = Points(np.arange(2), np.array([12.0, 28.0]), np.array([4.0, 26.0]), 2 * ones, ones)
    got = compute_accuracy(2, labels, found, 0.5)
    assert got["mean_px"] == pytest.approx(3.0)
    assert got["precision"] == got["recall"] == 1.0
    assert got["depth_mae_m"] == pytest.approx(np.e - 2)
