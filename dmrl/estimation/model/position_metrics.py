"""Compare estimated positions and their covariance with the ground truth.

Only horizontal errors count. The vertical comes straight from two height sensors and does not
depend on the estimator.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array

Mask = NDArray[np.bool_]
Times = NDArray[np.int64]

MAX_GOOD_ERROR_M = 0.3
"""Largest horizontal error of a good label, metres. No record of how the value was chosen; it
equals ``GATE_M``."""
WRONG_BASIN_SHARE = 0.5
"""A pair is in the wrong basin if its median error exceeds this share of the median distance. No
record of how the value was chosen."""
CHI2_95_OF_2 = 5.991
"""95 % point of chi-square with two degrees of freedom."""
MAX_TRUTH_GAP_S = 0.25
"""Longest gap over which the truth is interpolated, seconds. No record of how the value was chosen.
"""

DEFINITIONS = {
    "rmse_m": "root of the mean squared horizontal error, after the settling time",
    "p95_m": "95th percentile of the horizontal error, after the settling time",
    "wrong_basin": "median horizontal error over half the median distance, after settling",
    "nees": "mean of the squared horizontal error over its covariance; 2 if that is right",
    "coverage_95": "share of true positions inside the 95 % ellipse, after the settling time",
    "good": f"share of all samples, from the start, with an error of at most {MAX_GOOD_ERROR_M} m",
    "kept": "share of all samples, from the start, with status OK",
    "precision": f"share of the kept samples with an error of at most {MAX_GOOD_ERROR_M} m",
    "recall": f"share of the samples with an error of at most {MAX_GOOD_ERROR_M} m that are kept",
    "kept_coverage_95": "share of true positions inside the 95 % ellipse, kept samples",
    "kept_rmse_m": "root of the mean squared horizontal error of the kept samples",
}
"""Definition of each figure, printed beside it."""


@dataclass(frozen=True, slots=True)
class ErrorTrace:
    """Errors over time, for a plot.

    Parameters
    ----------
    title, name
        Title of the figure, and its file name.
    time_s
        (N,) seconds.
    sigma_m
        (N, A) standard deviations along A axes, as estimated.
    errors_m
        (N, A) errors by estimator, NaN where there are none. The last one is drawn on top.
    """

    title: str
    name: str
    time_s: Array
    sigma_m: Array
    errors_m: Mapping[str, Array]


@dataclass(frozen=True, slots=True)
class EvaluatedPositions:
    """Estimates of one pair beside the truth, (N, ...) each.

    Parameters
    ----------
    time_s
        Seconds from the first estimate of the recording.
    error_m
        (N, 2) estimate minus truth, x and y of the observer's horizontal frame.
    covariance
        (N, 2, 2) of x and y, square metres; NaN where there is none.
    distance_m
        True horizontal distance.
    kept
        Whether the status is OK.
    """

    time_s: Array
    error_m: Array
    covariance: Array
    distance_m: Array
    kept: Mask

    @property
    def error_norm_m(self) -> Array:
        """(N,) Euclidean norm of the errors, metres."""
        return np.asarray(np.linalg.norm(self.error_m, axis=1))

    @property
    def sigma_m(self) -> Array:
        """(N, 2) standard deviations of x and y, metres."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


@dataclass(frozen=True, slots=True)
class PairFigures:
    """Values of the figures in ``DEFINITIONS``; NaN without data."""

    samples: int
    rmse_m: float
    p95_m: float
    wrong_basin: float
    nees: float
    coverage_95: float
    good: float
    kept: float
    precision: float
    recall: float
    kept_coverage_95: float
    kept_rmse_m: float


def compute_figures(positions: EvaluatedPositions, settle_s: float) -> PairFigures:
    """Compute the figures of one pair.

    Parameters
    ----------
    judged
        Estimates beside the truth.
    settle_s
        Settling time. Earlier errors count for the figures of the gate only.
    """
    size_m, settled = positions.error_norm_m, positions.time_s >= settle_s
    late, distance = size_m[settled], positions.distance_m[settled]
    squared = mahalanobis_squared(positions)
    usable = np.isfinite(squared)
    good, kept = size_m <= MAX_GOOD_ERROR_M, positions.kept
    return PairFigures(
        samples=len(size_m),
        rmse_m=_root_mean_square(late),
        p95_m=float(np.percentile(late, 95)) if late.size else np.nan,
        wrong_basin=float(np.median(late) > WRONG_BASIN_SHARE * np.median(distance))
        if late.size
        else np.nan,
        nees=_mean_or_nan(squared[usable & settled]),
        coverage_95=_mean_or_nan(squared[usable & settled] <= CHI2_95_OF_2),
        good=_mean_or_nan(good),
        kept=_mean_or_nan(kept),
        precision=_mean_or_nan(good[kept]),
        recall=_mean_or_nan(kept[good]),
        kept_coverage_95=_mean_or_nan(squared[usable & kept] <= CHI2_95_OF_2),
        kept_rmse_m=_root_mean_square(size_m[kept]),
    )


def mahalanobis_squared(positions: EvaluatedPositions) -> Array:
    """Return (N,) squared Mahalanobis distances of the errors.

    They are NaN where a covariance is not positive definite.
    """
    (a, b), (_, d) = positions.covariance.transpose(1, 2, 0)
    x, y = positions.error_m.T
    determinant = a * d - b * b
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = (d * x * x - 2 * b * x * y + a * y * y) / determinant
    return np.where((a > 0) & (determinant > 0), squared, np.nan)


def combine_figures(pairs: list[PairFigures]) -> PairFigures:
    """Combine the figures of several pairs.

    RMSE and percentile are medians over pairs. The share of wrong basins counts pairs. Shares of
    samples count every sample of every pair once.
    """
    samples = np.array([f.samples for f in pairs], float)
    kept = samples * [f.kept for f in pairs]
    good = samples * [f.good for f in pairs]
    both = good * np.nan_to_num([f.recall for f in pairs])
    return PairFigures(
        samples=int(samples.sum()),
        rmse_m=_median_or_nan([f.rmse_m for f in pairs]),
        p95_m=_median_or_nan([f.p95_m for f in pairs]),
        wrong_basin=_mean_or_nan(_drop_non_finite([f.wrong_basin for f in pairs])),
        nees=_mean_or_nan(_drop_non_finite([f.nees for f in pairs])),
        coverage_95=_mean_or_nan(_drop_non_finite([f.coverage_95 for f in pairs])),
        good=_divide_or_nan(good.sum(), samples.sum()),
        kept=_divide_or_nan(kept.sum(), samples.sum()),
        precision=_divide_or_nan(both.sum(), kept.sum()),
        recall=_divide_or_nan(both.sum(), good.sum()),
        kept_coverage_95=_mean_or_nan(_drop_non_finite([f.kept_coverage_95 for f in pairs])),
        kept_rmse_m=_median_or_nan([f.kept_rmse_m for f in pairs]),
    )


def _divide_or_nan(part: float, whole: float) -> float:
    return float(part / whole) if whole else float("nan")


def _drop_non_finite(values: list[float]) -> Array:
    return np.array([value for value in values if np.isfinite(value)])


def _mean_or_nan(values: Array | Mask) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def _median_or_nan(values: list[float]) -> float:
    known = _drop_non_finite(values)
    return float(np.median(known)) if known.size else float("nan")


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def is_covered_by_truth(time_ns: Times, true_ns: Times) -> NDArray[np.bool_]:
    """Return (N,) whether true positions exist shortly before and after a time."""
    if not len(true_ns):
        return np.zeros(len(time_ns), bool)
    after = np.searchsorted(true_ns, time_ns)
    exact = true_ns[np.minimum(after, len(true_ns) - 1)] == time_ns
    between = (after > 0) & (after < len(true_ns))
    low = true_ns[np.maximum(after - 1, 0)]
    high = true_ns[np.minimum(after, len(true_ns) - 1)]
    return np.asarray(exact | (between & (high - low <= MAX_TRUTH_GAP_S * 1e9)))
