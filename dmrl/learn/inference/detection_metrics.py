"""Metrics of detections against labels, by distance, with bootstrap intervals. NumPy only.

Every metric is a function of one weight per image. The same code thus gives the value (all weights
1) and its bootstrap (weights are how often an image was drawn). Intervals are 95 % percentile
intervals over images. ``METRIC_DEFINITIONS`` defines the metrics.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dmrl.learn.inference.matching import (
    Array,
    Index,
    LabelErrors,
    Points,
    compute_errors,
    match_within_radius,
)

DEPTH_BANDS_M = ((0.0, np.inf), (0.0, 0.5), (0.5, 1.0), (1.0, 1.5), (1.5, 2.0), (2.0, np.inf))
"""Bands of the label's depth, metres, lower end included; the first contains all labels."""

Band = tuple[float, float]
BandMap = Callable[[Callable[[Band], "BandMetrics"], Sequence[Band]], Iterable["BandMetrics"]]

SCORE_RADIUS_PX = 16.0
"""Radius within which a detection is correct, pixels."""


@dataclass(frozen=True, slots=True)
class MetricValue:
    """One metric with its 95 % interval; NaN if there is nothing to measure."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class BandMetrics:
    """Metrics of the labels in one depth band.

    Parameters
    ----------
    from_m, to_m
        Limits of the band, lower end included.
    labels, images, unmatched
        Labels in the band, images that contain them, and labels without any detection.
    figures
        Metrics by the names of ``METRIC_DEFINITIONS``.
    """

    from_m: float
    to_m: float
    labels: int
    images: int
    unmatched: int
    figures: dict[str, MetricValue]


@dataclass(frozen=True, slots=True)
class ScoredDetections:
    """Labels and detections of ``images`` images, matched.

    Parameters
    ----------
    images
        Number of images, including those without labels.
    label_error
        Error of each label.
    right_8_px, right_16_px
        Label that each detection matches within 8 and 16 px, -1 for none.
    """

    images: int
    labels: Points
    detections: Points
    label_error: LabelErrors
    right_8_px: Index
    right_16_px: Index


def score_detections(
    images: int, labels: Points, detections: Points, blur_px: float | Array = 0.0
) -> ScoredDetections:
    """Match labels and detections; ``blur_px`` (L,) is added to the radius around each label."""
    return ScoredDetections(
        images,
        labels,
        detections,
        compute_errors(labels, detections),
        match_within_radius(labels, detections, 8.0 + blur_px),
        match_within_radius(labels, detections, SCORE_RADIUS_PX + blur_px),
    )


def compute_band_metrics(
    scored: ScoredDetections,
    *,
    threshold: float,
    draws: int = 1000,
    seed: int = 0,
    across: BandMap = map,
) -> list[BandMetrics]:
    """Compute the metrics over all distances, then for each band of ``DEPTH_BANDS_M``.

    Parameters
    ----------
    scored
        Matched labels and detections.
    threshold
        Confidence at or above which a detection counts in precision, recall and F1.
    draws
        Number of bootstrap samples.
    seed
        Seed of the bootstrap.
    across
        Function that maps over the bands in their order, such as `map` or a parallel map.
    """
    one = partial(_bootstrap_band, scored=scored, threshold=threshold, draws=draws, seed=seed)
    return list(across(one, DEPTH_BANDS_M))


def _bootstrap_band(
    band: Band, scored: ScoredDetections, threshold: float, draws: int, seed: int
) -> BandMetrics:
    inside = _in_band(scored.labels.depth_m, band)
    value = compute_metrics(scored, band, threshold, np.ones((1, scored.images)))
    blocks = [
        compute_metrics(scored, band, threshold, weights)
        for weights in iter_bootstrap_weights(scored, draws, seed)
    ]
    out = {}
    for name, (point,) in value.items():
        sample = np.concatenate([block[name] for block in blocks])
        sample = sample[np.isfinite(sample)]
        # Nearest ranks, so that an infinite neighbour does not turn a limit into NaN.
        low, high = (
            np.quantile(sample, (0.025, 0.975), method="inverted_cdf")
            if len(sample) and np.isfinite(point)
            else (np.nan, np.nan)
        )
        out[name] = MetricValue(float(point), float(low), float(high))
    return BandMetrics(
        *band,
        labels=int(inside.sum()),
        images=len(np.unique(scored.labels.image[inside])),
        unmatched=int(np.isinf(scored.label_error.norm_px[inside]).sum()),
        figures=out,
    )


@dataclass(frozen=True, slots=True)
class MetricCurves:
    """Precision-recall curve and reliability diagram.

    Parameters
    ----------
    confidence, precision, recall
        (K,) of all detections at or above that confidence, most confident first.
    bin_confidence, bin_right, bin_count
        (10,) mean confidence, fraction of correct detections, and number of detections per tenth of
        the confidence; NaN for an empty bin.
    """

    confidence: Array
    precision: Array
    recall: Array
    bin_confidence: Array
    bin_right: Array
    bin_count: Index


def compute_curves(scored: ScoredDetections, most: int = 200) -> MetricCurves:
    """Compute precision over recall, and reliability; detections are correct within 16 px.

    Parameters
    ----------
    scored
        Matched labels and detections.
    most
        Maximum number of points of the curve, evenly spaced over the detections.
    """
    confidence = scored.detections.confidence
    order = np.argsort(-confidence, kind="stable")
    right = (scored.right_16_px >= 0)[order]
    found = np.cumsum(right)
    # Detections of equal confidence are included together.
    last = np.flatnonzero(np.diff(confidence[order], append=-1.0))
    last = last[np.unique(np.linspace(0, len(last) - 1, min(most, len(last))).round().astype(int))]
    place = np.clip((confidence[order] * 10).astype(int), 0, 9)
    count = np.bincount(place, minlength=10)
    with np.errstate(invalid="ignore", divide="ignore"):
        return MetricCurves(
            confidence[order][last],
            found[last] / (last + 1.0),
            found[last] / np.float64(len(scored.labels)),
            np.bincount(place, confidence[order], minlength=10) / count,
            np.bincount(place, right, minlength=10) / count,
            count,
        )


def iter_bootstrap_weights(scored: ScoredDetections, draws: int, seed: int) -> Iterator[Array]:
    """Yield bootstrap weights in blocks (b, images), ``draws`` rows in all.

    A weight is the number of times an image was drawn.
    """
    rng = np.random.default_rng(seed)
    widest = max(scored.images, len(scored.labels), len(scored.detections), 1)
    block = max(1, 2_000_000 // widest)
    for start in range(0, draws, block):
        rows = min(block, draws - start)
        drawn = rng.integers(scored.images, size=(rows, scored.images))
        drawn += np.arange(rows)[:, None] * scored.images
        counts = np.bincount(drawn.ravel(), minlength=rows * scored.images)
        yield counts.reshape(rows, scored.images).astype(np.float64)


def compute_metrics(
    scored: ScoredDetections, band: Band, threshold: float, weights: Array
) -> dict[str, Array]:
    """Compute every metric for (b, images) weights: name to (b,) values."""
    inside = _in_band(scored.labels.depth_m, band)
    out = _error_metrics(scored, inside, weights[:, scored.labels.image[inside]])
    total = weights[:, scored.labels.image[inside]].sum(axis=1)
    right, wrong = _classify_detections(scored, scored.right_16_px, band, inside)
    sure = scored.detections.confidence >= threshold
    seen = weights[:, scored.detections.image]
    true, false = seen @ (right & sure), seen @ (wrong & sure)
    with np.errstate(invalid="ignore", divide="ignore"):
        out["precision"], out["recall"] = true / (true + false), true / total
        out["f1"] = 2 * true / (true + false + total)
        for name, taken in (("ap_8_px", scored.right_8_px), ("ap_16_px", scored.right_16_px)):
            judged = _classify_detections(scored, taken, band, inside)
            out[name] = average_precision(scored.detections.confidence, *judged, seen, total)
    return out


def _error_metrics(
    scored: ScoredDetections, inside: NDArray[np.bool_], weights: Array
) -> dict[str, Array]:
    error = scored.label_error
    norm_px = error.norm_px[inside]
    found = np.isfinite(norm_px)
    matched = weights[:, found]
    with np.errstate(invalid="ignore", divide="ignore"):

        def mean(values: Array, by: Array = matched) -> Array:
            result: Array = (by @ values) / by.sum(axis=1)
            return result

        def r_squared(errors: Array, values: Array, by: Array) -> Array:
            """Return R2: the share of the labels' variance that detections explain."""
            variance = mean(values**2, by) - mean(values, by) ** 2
            result: Array = 1 - mean(errors**2, by) / variance
            return result

        labels, depth_m = scored.labels.select(inside), error.depth_m[inside]
        known = np.isfinite(depth_m)
        depth_m, by_depth = depth_m[known], weights[:, known]
        return {
            "median_px": compute_weighted_quantile(norm_px, weights, 0.5),
            "mean_px": mean(norm_px[found]),
            "rmse_px": np.sqrt(mean(norm_px[found] ** 2)),
            "p95_px": compute_weighted_quantile(norm_px, weights, 0.95),
            "within_8_px": mean((norm_px <= 8).astype(np.float64), weights),
            "within_20_px": mean((norm_px <= 20).astype(np.float64), weights),
            "bias_u_px": compute_weighted_quantile(error.u_px[inside][found], matched, 0.5),
            "bias_v_px": compute_weighted_quantile(error.v_px[inside][found], matched, 0.5),
            "depth_mae_m": mean(np.abs(depth_m), by_depth),
            "depth_rmse_m": np.sqrt(mean(depth_m**2, by_depth)),
            "r2_u": r_squared(error.u_px[inside][found], labels.u_px[found], matched),
            "r2_v": r_squared(error.v_px[inside][found], labels.v_px[found], matched),
            "r2_depth": r_squared(depth_m, labels.depth_m[known], by_depth),
        }


def compute_weighted_quantile(values: Array, weights: Array, share: float) -> Array:
    """Return (b,) quantiles of (n,) values under (b, n) weights, as if repeated that often.

    If the quantile falls between two values, it is their mean, so the median of an even number of
    values is the usual one. NaN if all weights are zero.
    """
    if not len(values):
        return np.full(len(weights), np.nan)
    order = np.argsort(values, kind="stable")
    ascending = values[order]
    mass = np.cumsum(weights[:, order], axis=1)
    wanted = mass[:, -1:] * share
    last = len(values) - 1
    below = np.minimum((mass < wanted - 1e-9).sum(axis=1), last)
    above = np.minimum((mass <= wanted + 1e-9).sum(axis=1), last)
    return np.where(mass[:, -1] > 0, (ascending[below] + ascending[above]) / 2, np.nan)


def average_precision(
    confidence: Array,
    right: NDArray[np.bool_],
    wrong: NDArray[np.bool_],
    weights: Array,
    total: Array,
) -> Array:
    """Return (b,) areas under the precision envelope over recall.

    No threshold separates equal confidences: they count together, whatever their order.

    Parameters
    ----------
    confidence, right, wrong
        (D,) of each detection; one that is neither right nor wrong is ignored.
    weights
        (b, D) of each detection.
    total
        (b,) weight of all labels.
    """
    judged = np.flatnonzero(right | wrong)
    order = judged[np.argsort(-confidence[judged], kind="stable")]
    mass = weights[:, order]
    # Precision peaks at correct detections, so the envelope needs no others.
    at = np.flatnonzero(right[order])
    true = mass[:, at]
    falling = -confidence[order]
    last = np.searchsorted(falling, falling[at], side="right") - 1
    claimed = np.cumsum(mass, axis=1)[:, last]
    found = np.cumsum(mass * right[order], axis=1)[:, last]
    precision = np.divide(found, claimed, out=np.zeros_like(claimed), where=claimed > 0)
    envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    area: Array = (envelope * true).sum(axis=1) / total
    return area


def _classify_detections(
    scored: ScoredDetections, taken: Index, band: Band, inside: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return (D,) correct and (D,) wrong detections of a band; others belong to other bands."""
    free = taken < 0
    right = np.zeros(len(taken), bool)
    right[~free] = inside[taken[~free]]
    return right, free & _in_band(scored.detections.depth_m, band)


def _in_band(depth_m: Array, band: Band) -> NDArray[np.bool_]:
    """Return whether depths are in a band; unknown ones, NaN, are in that of all depths."""
    inside: NDArray[np.bool_] = (band[0] <= depth_m) & (depth_m < band[1])
    return inside | np.isnan(depth_m) if band == DEPTH_BANDS_M[0] else inside
