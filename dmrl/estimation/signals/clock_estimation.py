"""Estimate offset and drift between clocks from signals that two of them recorded.

Two robots that range to each other measure one distance, each on its own clock. A camera and a
gyroscope measure one rotation. The two series are aligned by cross-correlation first, then by
Gauss-Newton with Huber weights.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import SIGMA_OF_MEDIAN

Array = NDArray[np.float64]

GRID_STEP_S = 0.05
"""Step of the common grid of both series, seconds. No record of how the value was chosen."""
SMOOTHING_STD_S = 0.15
"""Standard deviation of the Gaussian that smooths both series, seconds. No record of how the value
was chosen."""
TREND_WINDOW_S = 20.0
"""Window of the running mean that is removed before the cross-correlation, seconds. Slower changes
inform little about an offset. No record of how the value was chosen."""
MAX_GAP_S = 1.0
"""Samples further apart than this leave a gap in a series, seconds. No record of how the value was
chosen."""
MIN_OVERLAP_S = 20.0
"""Shortest overlap of two series, seconds. No record of how the value was chosen."""
MAX_ITERATIONS = 30
"""Largest number of Gauss-Newton iterations. No record of how the value was chosen."""
HUBER_SIGMAS = 1.5
"""Residual beyond which the Huber weight falls, in standard deviations. No record of how the value
was chosen."""
CORRELATED_SAMPLES = 2 * np.sqrt(np.pi) * SMOOTHING_STD_S / GRID_STEP_S
"""Number of neighbouring samples that count as one: the integral of the autocorrelation of smoothed
white noise."""
DRIFT_STD = 30e-6
"""Prior standard deviation of the drift between two quartz clocks, seconds per second."""
MIN_CORRELATION = 0.5
"""Smallest correlation of two series that are accepted as the same signal. No record of how the
value was chosen."""


@dataclass(frozen=True, slots=True)
class Clock:
    """Correction of one clock's times to another clock.

    Parameters
    ----------
    offset_s
        Seconds to add at ``at_s``.
    drift
        Seconds to add per second after ``at_s``: 20e-6 is 20 ppm.
    at_s
        Middle of the overlap, on the corrected clock.
    sigma_s
        Standard deviation of the offset at ``at_s``.
    sigma_drift
        Standard deviation of the drift.
    correlation
        Correlation of the two aligned series; 1 is perfect.
    by
        Signal that both clocks recorded.
    """

    offset_s: float
    drift: float = 0.0
    at_s: float = 0.0
    sigma_s: float = 0.0
    sigma_drift: float = 0.0
    correlation: float = 1.0
    by: str = ""

    def correct_times(self, time_s: Array) -> Array:
        """Return (N,) times on the other clock."""
        return np.asarray(time_s + self.offset_s + self.drift * (time_s - self.at_s))

    def compose_after(self, first: "Clock") -> "Clock":
        """Return the correction by ``first``, followed by this one."""
        at = first.at_s
        middle = float(first.correct_times(np.array([at]))[0])
        offset = float(self.correct_times(np.array([middle]))[0]) - at
        return Clock(
            offset,
            (1 + first.drift) * (1 + self.drift) - 1,
            at,
            float(np.hypot(first.sigma_s, self.sigma_s)),
            float(np.hypot(first.sigma_drift, self.sigma_drift)),
            min(first.correlation, self.correlation),
            ", ".join(dict.fromkeys(by for by in (first.by, self.by) if by)),
        )

    def invert(self) -> "Clock":
        """Return the inverse correction."""
        drift = 1 / (1 + self.drift) - 1
        return Clock(
            -self.offset_s,
            drift,
            self.at_s + self.offset_s,
            self.sigma_s,
            self.sigma_drift,
            self.correlation,
            self.by,
        )


def estimate_clock(
    reference_s: Array, reference: Array, time_s: Array, values: Array
) -> Clock | None:
    """Estimate the correction of a series' times to those of another series of the same signal.

    Parameters
    ----------
    reference_s, reference
        (N,) times on the reference clock, increasing, and values.
    time_s, values
        (M,) the same on the clock to correct. Its values may be biased and scaled.

    Returns
    -------
    Clock | None
        None if the overlap is too short, or the series do not correlate.
    """
    if min(len(reference_s), len(time_s)) < 10:
        return None
    one = Series.from_samples(reference_s, reference)
    other = Series.from_samples(time_s, values)
    if one is None or other is None:
        return None
    lag_s = cross_correlate(one, other)
    return None if lag_s is None else refine_lag(one, other, lag_s)


@dataclass(frozen=True, slots=True)
class Series:
    """A smoothed series on a grid of ``GRID_STEP_S``, with the samples that are not in a gap."""

    start_s: float
    values: Array
    known: NDArray[np.bool_]

    @property
    def time_s(self) -> Array:
        """(N,) times, seconds."""
        return np.asarray(self.start_s + GRID_STEP_S * np.arange(len(self.values)))

    def without_trend(self) -> Array:
        """Return the values less their running mean."""
        return np.asarray(self.values - _running_mean(self.values))

    @classmethod
    def from_samples(cls, time_s: Array, values: Array) -> "Series | None":
        """Resample and smooth a series; None if it is too short."""
        count = int((time_s[-1] - time_s[0]) / GRID_STEP_S) + 1
        if count * GRID_STEP_S < MIN_OVERLAP_S:
            return None
        grid = time_s[0] + GRID_STEP_S * np.arange(count)
        # The median of three removes single outliers, which ranges have.
        inner = np.median(np.stack([values[:-2], values[1:-1], values[2:]]), axis=0)
        clean = np.concatenate([values[:1], inner, values[-1:]])
        after = np.clip(np.searchsorted(time_s, grid), 1, len(time_s) - 1)
        known = time_s[after] - time_s[after - 1] < MAX_GAP_S
        return cls(
            float(time_s[0]),
            _smooth_gaussian(np.interp(grid, time_s, clean), SMOOTHING_STD_S),
            known,
        )


def _smooth_gaussian(values: Array, std_s: float) -> Array:
    """Convolve with a Gaussian of a standard deviation in seconds."""
    reach = int(4 * std_s / GRID_STEP_S)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * GRID_STEP_S / std_s) ** 2)
    padded = np.pad(values, reach, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


def cross_correlate(
    one: Series, other: Series, min_overlap_s: float = MIN_OVERLAP_S
) -> float | None:
    """Return the seconds to add to the other's times, to one step; None without correlation."""
    a, b = (np.where(s.known, s.without_trend(), 0.0) for s in (one, other))
    size = 1 << int(np.ceil(np.log2(len(a) + len(b))))

    def correlate(x: Array, y: Array) -> Array:
        return np.asarray(np.fft.irfft(np.fft.rfft(x, size) * np.conj(np.fft.rfft(y, size)), size))

    # The correlation coefficient of every lag, over the samples outside gaps of both. Sums of
    # products and of squares are correlations too, so an FFT computes them for all lags at once.
    shared = correlate(one.known.astype(float), other.known.astype(float))
    energy = correlate(a**2, other.known.astype(float)) * correlate(one.known.astype(float), b**2)
    score = correlate(a, b) / np.sqrt(np.maximum(energy, 1e-12))
    score[shared * GRID_STEP_S < min_overlap_s] = -1
    best = int(np.argmax(score))
    # Half the final threshold: this search ignores the drift and fractions of a step.
    if score[best] < MIN_CORRELATION / 2:
        return None
    # The second half of a circular correlation contains the negative lags.
    lag = best if best < size // 2 else best - size
    return one.start_s - other.start_s + lag * GRID_STEP_S


def _running_mean(values: Array) -> Array:
    """Return a running mean, at a cost independent of its window."""
    width = min(int(TREND_WINDOW_S / GRID_STEP_S), len(values)) | 1
    padded = np.pad(values, width // 2, mode="edge")
    total = np.cumsum(np.concatenate([[0.0], padded]))
    return np.asarray(total[width:] - total[:-width])[: len(values)] / width


class _Fit(NamedTuple):
    """Normal equations of offset, drift, scale and bias; variance and correlation of the series."""

    normal: Array
    gradient: Array
    variance: float
    correlation: float


def _linearize(one: Series, then: Array, from_middle: Array, wanted: Array, drift: float) -> _Fit:
    """Linearize one series at the times ``then`` against another's values ``wanted``."""
    seen = np.interp(then, one.time_s, one.values)
    known = np.interp(then, one.time_s, one.known) > 0.5
    rate = np.interp(then, one.time_s, np.gradient(one.values, GRID_STEP_S))
    # Offset and drift of the clock, scale and bias of the values.
    jacobian = np.stack([rate, rate * from_middle, seen, np.ones(len(seen))], axis=1)[known]
    scale_bias = np.linalg.lstsq(jacobian[:, 2:], wanted[known], rcond=None)[0]
    residual = wanted[known] - jacobian[:, 2:] @ scale_bias
    spread = SIGMA_OF_MEDIAN * np.median(np.abs(residual)) + 1e-12
    weight = np.minimum(1.0, HUBER_SIGMAS * spread / np.maximum(np.abs(residual), 1e-12))
    full = jacobian * (scale_bias[0], scale_bias[0], 1.0, 1.0)
    # Smoothing correlates neighbouring samples: this many of them count as one.
    variance = float((weight * residual**2).mean()) * CORRELATED_SAMPLES
    normal = full.T @ (weight[:, None] * full)
    gradient = full.T @ (weight * residual)
    # The prior of the drift, in the units of the normal equations. Short flights barely observe it.
    normal[1, 1] += variance / DRIFT_STD**2
    gradient[1] -= variance / DRIFT_STD**2 * drift
    correlation = float(np.corrcoef(seen[known], wanted[known])[0, 1])
    return _Fit(normal, gradient, variance, correlation)


def refine_lag(one: Series, other: Series, lag_s: float) -> Clock | None:
    """Refine a lag by Gauss-Newton; None if the series do not correlate."""
    time_s, grid_s = other.time_s, one.time_s
    share = other.known & (time_s + lag_s > grid_s[0]) & (time_s + lag_s < grid_s[-1])
    time_s, wanted = time_s[share], other.values[share]
    if len(time_s) * GRID_STEP_S < MIN_OVERLAP_S:
        return None
    at_s = float(time_s.mean())
    from_middle = time_s - at_s
    offset_s, drift = lag_s, 0.0
    for _ in range(MAX_ITERATIONS):
        then = time_s + offset_s + drift * from_middle
        fit = _linearize(one, then, from_middle, wanted, drift)
        if np.linalg.cond(fit.normal) > 1e15:
            return None
        step = np.linalg.solve(fit.normal, fit.gradient)
        offset_s, drift = offset_s + step[0], drift + step[1]
        if abs(step[0]) < 1e-7 and abs(step[1]) < 1e-10:
            break
    if not fit.correlation >= MIN_CORRELATION:
        return None
    offset_std, drift_std = np.sqrt(np.diag(np.linalg.inv(fit.normal))[:2] * fit.variance).tolist()
    return Clock(float(offset_s), float(drift), at_s, offset_std, drift_std, fit.correlation)


def connect_clocks(pairs: dict[tuple[str, str], Clock], reference: str) -> dict[str, Clock]:
    """Connect the clocks of all robots to a reference, by the most certain links.

    Parameters
    ----------
    pairs
        By (reference, robot): correction of the robot's times to the reference's.
    reference
        Robot whose times stay.

    Returns
    -------
    dict
        Correction by robot, the reference included. Robots without a connection are missing.
    """
    links = pairs | {(b, a): clock.invert() for (a, b), clock in pairs.items()}
    found = {reference: Clock(0.0)}
    while True:
        ready = [
            (clock.sigma_s + found[a].sigma_s, a, b)
            for (a, b), clock in links.items()
            if a in found and b not in found
        ]
        if not ready:
            return found
        _, a, b = min(ready)
        found[b] = found[a].compose_after(links[a, b])
