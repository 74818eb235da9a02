"""Find a jump of one clock against another from a signal that both recorded.

The cost of every offset is summed over time. A clock that jumps has one offset before and another
after: their least costs, over all times of a jump, are compared with the least cost of one offset,
and of a drift, which a jump would explain in part.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from dmrl.estimation.model.pair import SIGMA_OF_MEDIAN
from dmrl.estimation.signals.clock_estimation import (
    CORRELATED_SAMPLES,
    GRID_STEP_S,
    MIN_OVERLAP_S,
    Array,
    Series,
    cross_correlate,
    refine_lag,
)

OFFSETS_S = GRID_STEP_S * np.arange(-40, 41)
"""Offsets that are compared, seconds: up to 2 s from that of the whole flight."""
DRIFTS = np.linspace(-5e-3, 5e-3, 101)
"""Drifts that are compared, seconds per second: a hundred times those of quartz clocks."""
BLOCK = round(CORRELATED_SAMPLES)
"""Samples that count as one, whose costs are summed: half a second."""
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
    split = _split(_Aligned.from_series(one, other, lag_s))
    if split is None:
        return None
    clocks = []
    sides = time_s < split.from_s, time_s >= split.from_s
    for at, offset_s in zip(sides, split.offsets_s, strict=True):
        part = Series.from_samples(time_s[at], values[at])
        clock = None if part is None else refine_lag(one, part, lag_s + offset_s)
        if clock is None:
            return None
        clocks.append(clock)
    earlier, later = clocks
    sigma_s = float(np.hypot(earlier.sigma_s, later.sigma_s))
    return ClockJump(split.from_s, later.offset_s - earlier.offset_s, sigma_s, split.gain)


@dataclass(frozen=True, slots=True)
class _Aligned:
    """A clock's series beside the reference, at the T times that overlap at all `OFFSETS_S`.

    ``time_s`` and ``values`` (T,) of the clock's series, ``lag_s`` to the reference ``grid_s``,
    ``wanted`` of it; ``known`` (T,) whether neither has a gap at any of the offsets.
    """

    time_s: Array
    values: Array
    lag_s: float
    grid_s: Array
    wanted: Array
    known: NDArray[np.bool_]

    @classmethod
    def from_series(cls, one: Series, other: Series, lag_s: float) -> Self:
        """Align a series to the reference ``one``."""
        grid_s, then = one.time_s, other.time_s + lag_s
        used = (then + OFFSETS_S[0] >= grid_s[0]) & (then + OFFSETS_S[-1] <= grid_s[-1])
        around = minimum_filter1d(one.known.astype(float), len(OFFSETS_S) + 2)
        known = other.known[used] & (np.interp(then[used], grid_s, around) == 1)
        values = other.without_trend()[used]
        return cls(other.time_s[used], values, lag_s, grid_s, one.without_trend(), known)

    @property
    def block_s(self) -> Array:
        """(B,) first times of blocks of `BLOCK` samples."""
        return self.time_s[::BLOCK]

    def residual(self, number: int) -> Array:
        """Return (T,) residuals at one of `OFFSETS_S`; zero where a series has a gap."""
        then = self.time_s + self.lag_s + OFFSETS_S[number]
        return np.asarray((np.interp(then, self.grid_s, self.wanted) - self.values) * self.known)

    def sum_costs(self) -> Array:
        """Return (D, B) squared residuals at `OFFSETS_S`, limited, and summed over blocks."""
        numbers = range(len(OFFSETS_S))
        best = min(numbers, key=lambda number: np.abs(self.residual(number)).sum())
        most = OUTLIER_SIGMAS**2 * _estimate_variance(self.residual(best))
        first = np.arange(0, len(self.time_s), BLOCK)
        each = (np.minimum(self.residual(number) ** 2, most) for number in numbers)
        return np.stack([np.add.reduceat(square, first) for square in each])


class _Split(NamedTuple):
    """Time of the likeliest jump, offsets before and after it, and the gain of the jump."""

    from_s: float
    offsets_s: tuple[float, float]
    gain: float


def _split(both: _Aligned) -> _Split | None:
    """Return the likeliest jump; None if the series are too short for one."""
    side = round(MIN_OVERLAP_S / GRID_STEP_S / BLOCK)
    if len(both.block_s) <= 2 * side:
        return None
    cost = both.sum_costs()
    before = cost.cumsum(axis=1)
    after = before[:, -1:] - before
    last = side + int((before.min(axis=0) + after.min(axis=0))[side:-side].argmin())
    first, second = int(before[:, last].argmin()), int(after[:, last].argmin())
    from_s = float(both.block_s[last + 1])
    rest = np.where(both.time_s < from_s, both.residual(first), both.residual(second))
    single = min(before[:, -1].min(), _sum_along_drifts(cost, both.block_s))
    gain = single - before[first, last] - after[second, last]
    gain /= 2 * _estimate_variance(rest) * CORRELATED_SAMPLES
    return _Split(from_s, (float(OFFSETS_S[first]), float(OFFSETS_S[second])), float(gain))


def _estimate_variance(residual: Array) -> float:
    """Return the variance of residuals that has few outliers' influence."""
    shown = np.abs(residual[residual != 0])
    return float(SIGMA_OF_MEDIAN * np.median(shown)) ** 2 if len(shown) else 1e-12


def _sum_along_drifts(cost: Array, at_s: Array) -> float:
    """Return the least sum of (D, B) costs along a clock that drifts."""
    blocks, best = np.arange(len(at_s)), np.inf
    for drift in DRIFTS:
        step = np.rint(drift * (at_s - at_s.mean()) / GRID_STEP_S).astype(int)
        offset = np.arange(max(0, -step.min()), len(cost) - max(0, step.max()))[:, None] + step
        best = min(best, cost[offset, blocks].sum(axis=1).min(initial=np.inf))
    return float(best)
