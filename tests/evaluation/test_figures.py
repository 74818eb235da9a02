"""Plots of errors over time."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dmrl.estimation.model.position_metrics import ErrorTrace
from dmrl.evaluation.figures import draw_error_plots


@dataclass(frozen=True)
class Judged:
    """An observer with errors over time."""

    trace: ErrorTrace


def trace(name: str, error_m: list[float]) -> Judged:
    time_s = np.arange(float(len(error_m)))
    errors = np.repeat(np.reshape(error_m, (-1, 1)), 3, axis=1).astype(float)
    return Judged(ErrorTrace(name, name, time_s, np.ones_like(errors), {"tracks": errors}))


def test_an_observer_without_a_known_error_has_no_plot(tmp_path: Path) -> None:
    known = [trace("seen", [0.1, np.nan]), trace("none", []), trace("lost", [np.nan, np.nan])]
    draw_error_plots(tmp_path, known)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["seen.png", "seen.svg"]
