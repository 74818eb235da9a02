"""Find a jump of one clock against another from a signal that both recorded.

The cost of every offset is summed over time. A clock that jumps has one offset before and another
after: their least costs, over all times of a jump, are compared with the least cost of one offset,
and of a drift, which a jump would explain in part.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import SIGMA_OF_MEDIAN
from dmrl.estimation.signals.clock_estimation import (
    CORRELATED_SAMPLES,
    GRID_STEP_S,
    MIN_OVERLAP_S,
    Array,
    Clock,
    Series,
    cross_correlate,
    refine_lag,
)

OFFSETS_S = GRID_STEP_S * np.arange(-40, 41)
"""Offsets that are compared, seconds: up to 2 s from that of the whole flight."""
DRIFTS = np.linspace(-5e-3, 5e-3, 101)
"""Drifts that are compared, seconds per second: a hundred times those of quartz clocks."""
BLOCK = round(CORRELATED_SAMPLES)
"""Samples that count as one: their costs are summed before drifts are compared."""
OUTLIER_SIGMAS = 3.0
"""Residual from which the cost is constant, standard deviations."""


@dataclass(frozen=True, slots=True)
class ClockJump:
    """A jump of one clock.

    Parameters
    ----------
    from_s
        Time of the jump on that clock, seconds.
    shift_s, sigma_s
        Seconds to add to its times from then on, and their standard deviation.
    gain
        Gain of the log likelihood over one offset, or a drift, whichever is less.
    """

    from_s: float
    shift_s: float
    sigma_s: float
    gain: float


def find_clock_jump(
    reference_s: Array, reference: Array, time_s: Array, values: Array
) -> ClockJump | None:
    """Find the likeliest jump of a clock; None if a side of it is too short or does not correlate.

    Parameters
    ----------
    reference_s, reference
        (N,) times on the reference clock, increasing, and values.
    time_s, values
        (M,) the same on the clock that may jump.
    """
    if min(len(reference_s), len(time_s)) < 10:
        return None
    one, other = Series.from_samples(reference_s, reference), Series.from_samples(time_s, values)
    if one is None or other is None:
        return None
    # Short parts of both may be alike, where a jump makes all of them less so.
    half_s = min(len(one.values), len(other.values)) * GRID_STEP_S / 2
    lag_s = cross_correlate(one, other, half_s)
    if lag_s is None:
        return None
    at_s, residual = _compute_residuals(one, other, lag_s)
    side = round(MIN_OVERLAP_S / GRID_STEP_S)
    if len(at_s) <= 2 * side:
        return None
    best = residual[np.abs(residual).sum(axis=1).argmin()]
    cost = np.minimum(residual**2, OUTLIER_SIGMAS**2 * _estimate_variance(best))
    before = cost.cumsum(axis=1)
    after = before[:, -1:] - before
    split = side + int((before.min(axis=0) + after.min(axis=0))[side:-side].argmin())
    first, second = int(before[:, split].argmin()), int(after[:, split].argmin())
    rest = np.append(residual[first, :split], residual[second, split:])
    single = min(before[:, -1].min(), _sum_along_drifts(cost, at_s))
    gain = single - before[first, split] - after[second, split]
    gain /= 2 * _estimate_variance(rest) * CORRELATED_SAMPLES
    from_s = float(at_s[split])

    def refine(at: NDArray[np.bool_], number: int) -> Clock | None:
        part = Series.from_samples(time_s[at], values[at])
        offset_s = lag_s + float(OFFSETS_S[number])
        return None if part is None else refine_lag(one, part, offset_s)

    earlier, later = refine(time_s < from_s, first), refine(time_s >= from_s, second)
    if earlier is None or later is None:
        return None
    sigma_s = float(np.hypot(earlier.sigma_s, later.sigma_s))
    return ClockJump(from_s, later.offset_s - earlier.offset_s, sigma_s, float(gain))


def _compute_residuals(one: Series, other: Series, lag_s: float) -> tuple[Array, Array]:
    """Return (T,) times on the other clock, and (D, T) residuals at `OFFSETS_S` from a lag.

    Residuals are zero where either series has a gap at one of the offsets.
    """
    grid_s, time_s = one.time_s, other.time_s + lag_s
    used = (time_s + OFFSETS_S[0] >= grid_s[0]) & (time_s + OFFSETS_S[-1] <= grid_s[-1])
    then = time_s[used] + OFFSETS_S[:, None]
    residual = np.interp(then, grid_s, one.without_trend()) - other.without_trend()[used]
    known = (np.interp(then, grid_s, one.known) > 0.5).all(axis=0) & other.known[used]
    return other.time_s[used], residual * known


def _estimate_variance(residual: Array) -> float:
    """Return the variance of residuals that has few outliers' influence."""
    shown = np.abs(residual[residual != 0])
    return float(SIGMA_OF_MEDIAN * np.median(shown)) ** 2 if len(shown) else 1e-12


def _sum_along_drifts(cost: Array, at_s: Array) -> float:
    """Return the least sum of (D, T) costs along a clock that drifts."""
    first = np.arange(0, len(at_s), BLOCK)
    block = np.add.reduceat(cost, first, axis=1)
    step = np.outer(DRIFTS, at_s[first] - at_s.mean()) / GRID_STEP_S
    offset = np.arange(len(cost))[:, None, None] + np.rint(step).astype(int)
    inside = ((offset >= 0) & (offset < len(cost))).all(axis=-1)
    sums = block[np.clip(offset, 0, len(cost) - 1), np.arange(len(first))].sum(axis=-1)
    return float(np.where(inside, sums, np.inf).min())
