"""Align the clocks of two robots by single ranging exchanges that both logged."""

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import SIGMA_OF_MEDIAN
from dmrl.estimation.signals.clock_estimation import (
    HUBER_SIGMAS,
    MAX_ITERATIONS,
    Array,
    Clock,
    estimate_clock,
)

MAX_RANGE_DIFFERENCE_M = 0.002
"""Largest difference between two logs of one exchange, metres. One of them may be rounded to
millimetres."""
MAX_TIME_DIFFERENCE_S = 0.3
"""Largest time difference of one exchange after the rough alignment, seconds. No record of how the
value was chosen."""
MIN_MATCHED_SHARE = 0.3
"""Smallest share of the ranges that must match. No record of how the value was chosen."""
MIN_JITTER_S = 0.01
"""Smallest spread of the log times in the robust fit, seconds: a polled log is late by whole
periods. No record of how the value was chosen."""


def estimate_from_exchanges(
    reference_s: Array, reference: Array, time_s: Array, values: Array
) -> Clock | None:
    """Estimate the correction of a robot's range times to those of the other robot.

    If both robots log the same exchanges, each exchange gives the clock difference to the jitter of
    the log. The rough alignment of the series pairs the exchanges. Otherwise the series alone are
    aligned.

    Parameters
    ----------
    reference_s, reference, time_s, values
        As for ``estimate_clock``: times and distances, metres.

    Returns
    -------
    Clock | None
        None if the overlap is too short.
    """
    rough = estimate_clock(reference_s, reference, time_s, values)
    if rough is None:
        return None
    start = rough.correct_times(time_s)
    index, apart_s = _match_exchanges(reference_s, reference, start, values)
    if len(index) < MIN_MATCHED_SHARE * len(time_s):
        return rough
    # The remaining time difference of each exchange, after the rough correction.
    from_middle = time_s[index] - rough.at_s
    slope, middle, sigmas = _fit_line(from_middle, apart_s)
    return Clock(
        rough.offset_s + middle,
        rough.drift + slope,
        rough.at_s,
        sigmas[1],
        sigmas[0],
        rough.correlation,
    )


def _match_exchanges(
    reference_s: Array, reference: Array, time_s: Array, values: Array
) -> tuple[NDArray[np.intp], Array]:
    """Match values that both logs contain; return their indices and time differences."""
    first = np.searchsorted(reference_s, time_s - MAX_TIME_DIFFERENCE_S)
    last = np.searchsorted(reference_s, time_s + MAX_TIME_DIFFERENCE_S)
    best = np.full(len(time_s), np.inf)
    apart = np.zeros(len(time_s))
    for step in range(int((last - first).max(initial=0))):
        at = np.minimum(first + step, len(reference_s) - 1)
        differ = np.where(first + step < last, np.abs(reference[at] - values), np.inf)
        nearer = differ < best
        best[nearer], apart[nearer] = differ[nearer], (reference_s[at] - time_s)[nearer]
    found = np.flatnonzero(best <= MAX_RANGE_DIFFERENCE_M)
    # Chance matches spread over +-MAX_TIME_DIFFERENCE_S; true ones are close to each other.
    middle = np.median(apart[found]) if len(found) else 0.0
    found = found[np.abs(apart[found] - middle) < MAX_TIME_DIFFERENCE_S / 4]
    return found, apart[found]


def _fit_line(x: Array, y: Array) -> tuple[float, float, tuple[float, float]]:
    """Fit a robust line; return its slope, its value at 0 and their standard deviations."""
    design = np.stack([x, np.ones(len(x))], axis=1)
    weight = np.ones(len(x))
    for _ in range(MAX_ITERATIONS):
        normal = design.T @ (weight[:, None] * design)
        slope, middle = np.linalg.solve(normal, design.T @ (weight * y))
        residual = np.abs(y - slope * x - middle)
        # A polled log is late by whole periods, which are no outliers.
        spread = max(SIGMA_OF_MEDIAN * float(np.median(residual)), MIN_JITTER_S)
        weight = np.minimum(1.0, HUBER_SIGMAS * spread / np.maximum(residual, 1e-9))
    covariance = np.linalg.inv(normal) * float((weight * residual**2).mean())
    return float(slope), float(middle), tuple(np.sqrt(np.diag(covariance)).tolist())
