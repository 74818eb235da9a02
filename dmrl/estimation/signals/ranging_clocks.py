"""Clocks from ranging exchanges that both robots of a pair logged, one by one."""

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.signals.clock_alignment import HUBER, ITERATIONS, Array, Clock, estimate_clock

SAME_M = 0.002
"""Two logs of one exchange differ by no more: one may be in whole millimetres."""
SAME_S = 0.3
"""Nor by more than this, after the rough alignment."""
SHARE = 0.3
POLLED_S = 0.01


def estimate_from_exchanges(
    reference_s: Array, reference: Array, time_s: Array, values: Array
) -> Clock | None:
    """How to correct the times of ranges to those of the other robot of the pair.

    Where both robots log the same exchanges, each gives the difference of the clocks to the
    jitter of the log; the series as a whole says which is which. Where they do not, the series
    is all there is.

    Parameters
    ----------
    reference_s, reference, time_s, values
        As for ``estimate_clock``: times and distances, metres.

    Returns
    -------
    Clock | None
        None where the two share too little.
    """
    rough = estimate_clock(reference_s, reference, time_s, values)
    if rough is None:
        return None
    start = rough.corrected(time_s)
    index, apart_s = _same_exchange(reference_s, reference, start, values)
    if len(index) < SHARE * len(time_s):
        return rough
    # Of each exchange: by how much the reference's log is later than the rough correction says.
    from_middle = time_s[index] - rough.at_s
    slope, middle, sigmas = _line(from_middle, apart_s)
    return Clock(
        rough.offset_s + middle,
        rough.drift + slope,
        rough.at_s,
        sigmas[1],
        sigmas[0],
        rough.correlation,
    )


def _same_exchange(
    reference_s: Array, reference: Array, time_s: Array, values: Array
) -> tuple[NDArray[np.intp], Array]:
    """Which values the other has too, at about the time, and by how much it is later."""
    first = np.searchsorted(reference_s, time_s - SAME_S)
    last = np.searchsorted(reference_s, time_s + SAME_S)
    best = np.full(len(time_s), np.inf)
    apart = np.zeros(len(time_s))
    for step in range(int((last - first).max(initial=0))):
        at = np.minimum(first + step, len(reference_s) - 1)
        differ = np.where(first + step < last, np.abs(reference[at] - values), np.inf)
        nearer = differ < best
        best[nearer], apart[nearer] = differ[nearer], (reference_s[at] - time_s)[nearer]
    found = np.flatnonzero(best <= SAME_M)
    # Chance hits are anywhere in +-SAME_S; true ones lie together.
    middle = np.median(apart[found]) if len(found) else 0.0
    found = found[np.abs(apart[found] - middle) < SAME_S / 4]
    return found, apart[found]


def _line(x: Array, y: Array) -> tuple[float, float, tuple[float, float]]:
    """Slope and value at 0 of a line through most of the points, and their deviations."""
    design = np.stack([x, np.ones(len(x))], axis=1)
    weight = np.ones(len(x))
    for _ in range(ITERATIONS):
        normal = design.T @ (weight[:, None] * design)
        slope, middle = np.linalg.solve(normal, design.T @ (weight * y))
        residual = np.abs(y - slope * x - middle)
        # Logs that are polled are late by whole periods: that is no outlier.
        spread = max(1.4826 * float(np.median(residual)), POLLED_S)
        weight = np.minimum(1.0, HUBER * spread / np.maximum(residual, 1e-9))
    covariance = np.linalg.inv(normal) * float((weight * residual**2).mean())
    return float(slope), float(middle), tuple(np.sqrt(np.diag(covariance)).tolist())
