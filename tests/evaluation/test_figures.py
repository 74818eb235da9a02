"""Plots of errors over time, and the choice of example images."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from dmrl.estimation.model.position_metrics import ErrorTrace
from dmrl.evaluation.figures import _Outcomes, draw_error_plots
from dmrl.learn.inference.detection_metrics import score_detections
from dmrl.learn.inference.matching import Points


@dataclass(frozen=True)
class Judged:
    """Evaluation of an observer with an error trace."""

    trace: ErrorTrace


def build_trace(name: str, error_m: list[float]) -> Judged:
    """Return a flight, a sample a second, with equal errors in all three axes."""
    time_s = np.arange(float(len(error_m)))
    errors = np.repeat(np.reshape(error_m, (-1, 1)), 3, axis=1).astype(float)
    return Judged(ErrorTrace(name, name, time_s, np.ones_like(errors), {"tracks": errors}))


@pytest.mark.heavy
def test_an_observer_without_a_known_error_has_no_plot(tmp_path: Path) -> None:
    known = [
        build_trace("seen", [0.1, np.nan]),
        build_trace("none", []),
        build_trace("lost", [np.nan, np.nan]),
    ]
    draw_error_plots(tmp_path, known)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["seen.png", "seen.svg"]


def build_points(*rows: tuple[int, float, float]) -> Points:
    """Return points at (u, 0) from rows of image, u and confidence."""
    image, u_px, confidence = (np.array(column) for column in zip(*rows, strict=True))
    return Points(image.astype(np.int64), u_px, 0 * u_px, 0 * u_px, confidence)


def test_examples_show_hits_misses_and_false_detections() -> None:
    labels = build_points(*((image, 100.0, 1.0) for image in range(6)))
    found = [(0, 101.0, 0.9), (1, 103.0, 0.9), (2, 101.0, 0.2), (4, 100.0, 0.9), (4, 50.0, 0.6)]
    detections = build_points(*found, (5, 50.0, 0.8), (6, 50.0, 0.7))
    outcomes = _Outcomes.of(score_detections(7, labels, detections), 0.5)
    # Image 2 has a correct detection below the threshold, 3 no detection, and 6 no robot.
    assert outcomes.choose() == [0, 1, 2, 5, 6, 4]
    words = [outcomes.describe(image) for image in range(7)]
    assert words == [
        "hit: 1.0 px",
        "hit: 3.0 px",
        "miss",
        "miss",
        "hit: 0.0 px, false detection: confidence 0.60",
        "miss, false detection: confidence 0.80",
        "false detection: confidence 0.70",
    ]
