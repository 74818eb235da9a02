"""Compare two models on the same images: paired differences with bootstrap intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dmrl.evaluation.detections import LabelledDetections
from dmrl.evaluation.figure_tables import (
    finite_values,
    format_interval,
    format_values,
    metric_columns,
)
from dmrl.learn.inference.detection_metrics import (
    DEPTH_BANDS_M,
    ScoredDetections,
    compute_metrics,
    iter_bootstrap_weights,
    score_detections,
)
from dmrl.learn.inference.matching import Points

Pair = tuple[LabelledDetections, LabelledDetections]
HEADERS = ("detection minus label", "first", "second", "second minus first", "differs")


def align_images(first: LabelledDetections, second: LabelledDetections) -> Pair | None:
    """Return two evaluations with their common images alone, in one order.

    None without common images, by robot and log time, or if their labels differ: these are other
    images of the same moments, as in two simulated flights.
    """
    known = {(at.robot, at.time_ns): k for k, at in enumerate(second.at)}
    both = [(k, known[key]) for k, at in enumerate(first.at) if (key := at[1:]) in known]
    mine = _select_images(first, [row for row, _ in both])
    theirs = _select_images(second, [row for _, row in both])
    return (mine, theirs) if both and _have_equal_labels(mine.labels, theirs.labels) else None


def _select_images(part: LabelledDetections, rows: Sequence[int]) -> LabelledDetections:
    place = np.full(part.images, -1)
    place[list(rows)] = np.arange(len(rows))
    return replace(
        part,
        at=[part.at[row] for row in rows],
        labels=_renumber(part.labels, place),
        detections=_renumber(part.detections, place),
    )


def _renumber(points: Points, place: Any) -> Points:
    kept = points.select(place[points.image] >= 0)
    kept = replace(kept, image=place[kept.image])
    return kept.select(np.argsort(kept.image, kind="stable"))


def _have_equal_labels(first: Points, second: Points) -> bool:
    return np.array_equal(first.image, second.image) and all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True)
        for name in ("u_px", "v_px", "depth_m")
    )


def compare_models(
    both: Pair, thresholds: Sequence[float], draws: int, seed: int
) -> dict[str, Any]:
    """Compare the detections of two models on the same images, as JSON values.

    A bootstrap sample draws the same images for both, so images that are hard or easy for both do
    not widen the interval of a difference.

    Parameters
    ----------
    both
        From `align_images`.
    thresholds
        Confidence from which a detection counts, for each.
    draws, seed
        Number of bootstrap samples, and their seed.
    """
    scored = [score_detections(part.images, part.labels, part.detections) for part in both]
    known = list(zip(scored, thresholds, strict=True))
    values = [_measure(*one, np.ones((1, both[0].images))) for one in known]
    widest = max(scored, key=lambda one: len(one.detections))
    drawn = iter_bootstrap_weights(widest, draws, seed)
    blocks = [[_measure(*one, weights) for one in known] for weights in drawn]
    figures = {}
    for name, *_ in metric_columns():
        first, second = (float(value[name][0]) for value in values)
        with np.errstate(invalid="ignore"):  # both infinite where neither model finds anything
            sample = np.concatenate([block[1][name] - block[0][name] for block in blocks])
        sample = sample[np.isfinite(sample)]
        measured = len(sample) and np.isfinite(second - first)
        ends = np.quantile(sample, (0.025, 0.975)) if measured else (np.nan, np.nan)
        low, high = map(float, ends)
        figures[name] = {
            **finite_values({"first": first, "second": second}),
            "difference": finite_values({"value": second - first, "low": low, "high": high}),
        }
    names = [part.at[0].recording.name for part in both]
    return {
        "recordings": names,
        "images": both[0].images,
        "thresholds": list(thresholds),
        "bootstrap": {"draws": draws, "seed": seed},
        "figures": figures,
    }


def _measure(scored: ScoredDetections, threshold: float, weights: Any) -> Mapping[str, Any]:
    return compute_metrics(scored, DEPTH_BANDS_M[0], threshold, weights)


def is_pooled(said: Mapping[str, Any]) -> bool:
    """Return whether all images of an evaluation are pairs: its own figures are of two models."""
    paired = said.get("paired")
    common = paired.get("images") if isinstance(paired, Mapping) else None
    return isinstance(common, int) and 2 * common == said.get("images")


def build_rows(made: Mapping[str, Any]) -> list[list[str]]:
    """Return a row per metric of a comparison: both values, and their difference.

    The difference from a value that says nothing, "< -1", is left out.
    """
    rows = []
    for name, title, form in metric_columns():
        found = made["figures"][name]
        change = found["difference"]
        sides = format_values(found, [(side, "", form) for side in ("first", "second")])
        ends = [change["low"], change["high"]]
        differs = None not in ends and (ends[0] > 0 or ends[1] < 0)
        told = not any(side.startswith("<") for side in sides)
        signed = format_interval(change, f"+{form.partition(' ')[0]}") if told else "-"
        rows.append([title, *sides, signed, "yes" if differs else ""])
    return rows


def note(made: Mapping[str, Any]) -> str:
    """Describe a comparison in one line."""
    first, second = made["recordings"]
    own = " and ".join(f"{threshold:.3g}" for threshold in made["thresholds"])
    return (
        f"first: {first}, second: {second}; {made['images']} common images. In brackets: 95 % "
        "interval of the difference, both models on the same images of a bootstrap. Precision, "
        f"recall and F1 are at confidence {own}"
    )
