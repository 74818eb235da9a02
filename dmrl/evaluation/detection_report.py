"""Evaluate detections against labels: figures by distance, as JSON values and as a table."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dmrl import topics
from dmrl.errors import SettingError
from dmrl.evaluation import comparison, figure_tables
from dmrl.evaluation.detections import LabelledDetections, concatenate_parts, join_each
from dmrl.evaluation.settings import Settings
from dmrl.labelling.flight_log import read_flight
from dmrl.labelling.recorded_camera import require_camera
from dmrl.learn.inference import detection_metrics
from dmrl.learn.inference.box_precision import BoxPrecision, compute_box_precision
from dmrl.learn.inference.detection_metrics import BandMetrics, ScoredDetections
from dmrl.learn.inference.detector_rates import measure_rates
from dmrl.learn.inference.metric_definitions import METRIC_DEFINITIONS
from dmrl.learn.inference.threshold import (
    MIN_EMPTY_IMAGES,
    MIN_LABELS,
    count_false_alarms,
    select_threshold,
)
from dmrl.terminal.tables import print_line, print_table

Spread = Callable[[Callable[..., Any], Sequence[Any], int], Iterator[Any]]
"""A function, its items and a number of processes to the results in their order."""

MIN_PARALLEL_DRAWS = 2_000_000
"""Images times draws from which more processes gain more time than they take to start."""
DEFAULT_THRESHOLD = 0.33
"""The published evaluation's threshold, for detectors that have none."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Evaluated recordings.

    Parameters
    ----------
    settings
        How they were evaluated.
    pairs
        Labels and detections.
    scored
        The same, matched.
    bands
        Figures over all distances, then by band.
    threshold
        The one that was used.
    paired
        Differences of two recordings with the same images and labels, as JSON values; else None.
    boxes
        Precision of the detections as boxes: of all recordings together, or of each of two that are
        compared. Empty: the width of the robots is not given.
    """

    settings: Settings
    pairs: LabelledDetections
    scored: ScoredDetections
    bands: list[BandMetrics]
    threshold: float
    paired: dict[str, Any] | None = None
    boxes: Sequence[BoxPrecision] = ()


def evaluate_detections(
    recordings: Sequence[Path], settings: Settings, workers: int, spread: Spread
) -> Evaluation:
    """Evaluate the detections of all recordings, image by image.

    Parameters
    ----------
    recordings
        With images, labels and detections.
    settings
        Labels, images and threshold.
    workers, spread
        Most processes that draw the intervals, and the function that runs them.

    Raises
    ------
    RecordingError
        If a recording cannot be read, or has no detections, labels or images; with boxes, if it
        has no calibration of the camera.
    SettingError
        If one has no labels of that source, no such split, or no image to evaluate.
    MissingExtra
        If boxes are wanted and pycocotools is not installed.
    """
    parts = join_each(recordings, settings.against, settings.split, partial=settings.partial)
    pairs = concatenate_parts(parts)
    scored = _score(pairs)
    threshold = _choose_threshold(scored, pairs, settings)
    if pairs.images * settings.draws < MIN_PARALLEL_DRAWS:
        workers = 1
    bands = detection_metrics.compute_band_metrics(
        scored,
        threshold=threshold,
        draws=settings.draws,
        seed=settings.seed,
        across=lambda function, items: spread(function, items, workers),
    )
    paired = None
    if len(parts) == 2 and (both := comparison.align_images(*parts)):
        chosen = [_choose_threshold(_score(part), part, settings) for part in both]
        paired = comparison.compare_models(both, chosen, settings.draws, settings.seed)
    width_m, judged = settings.robot_width_m, parts if paired else [pairs]
    boxes = [] if width_m is None else [judge_boxes(one, width_m) for one in judged]
    return Evaluation(settings, pairs, scored, bands, threshold, paired, boxes)


def judge_boxes(pairs: LabelledDetections, robot_width_m: float) -> BoxPrecision:
    """Judge detections as boxes of robots of a width, metres; see `evaluate_detections`."""
    taken = {(key.recording, key.robot) for key in pairs.at}
    flights = {path: read_flight(path, topics.CALIBRATION) for path, _ in taken}
    found = {(path, robot): require_camera(flights[path], robot) for path, robot in taken}
    cameras = [found[key.recording, key.robot] for key in pairs.at]
    return compute_box_precision(cameras, pairs.labels, pairs.detections, robot_width_m)


def _score(pairs: LabelledDetections) -> ScoredDetections:
    return detection_metrics.score_detections(pairs.images, pairs.labels, pairs.detections)


def _choose_threshold(
    scored: ScoredDetections, pairs: LabelledDetections, settings: Settings
) -> float:
    """Return the given threshold, that of the rate of false alarms, or the detector's own."""
    if settings.false_alarms is None:
        own = pairs.threshold or DEFAULT_THRESHOLD
        return own if settings.threshold is None else settings.threshold
    if settings.threshold is not None:
        raise SettingError("--threshold and --false-alarms cannot be combined. Pass one of them")
    empty = count_false_alarms(scored, 0.0).empty_images
    chosen = select_threshold(scored, settings.false_alarms)
    if chosen is None or empty < MIN_EMPTY_IMAGES:
        raise SettingError(
            f"--false-alarms wants {MIN_LABELS} labels, some of them found, and {MIN_EMPTY_IMAGES} "
            f"images without a robot: there are {len(scored.labels)} and {empty}. Give --threshold"
        )
    return chosen


def describe_evaluation(recordings: Sequence[Path], evaluation: Evaluation) -> dict[str, Any]:
    """Return all figures as JSON values; null where there was nothing to measure.

    One recording is ``recording``, several are ``recordings``.
    """
    settings = evaluation.settings
    sources = [figure_tables.describe_source(path) for path in recordings]
    alarms = count_false_alarms(evaluation.scored, evaluation.threshold)
    overall, *bands = [figure_tables.band_to_json(band) for band in evaluation.bands]
    return {
        **({"recordings": sources} if len(sources) > 1 else {"recording": sources[0]}),
        "against": settings.against,
        "split": settings.split,
        "threshold": evaluation.threshold,
        "images": evaluation.pairs.images,
        "labels": len(evaluation.pairs.labels),
        "detections": len(evaluation.pairs.detections),
        "partial": settings.partial,
        "images_without_detections": evaluation.pairs.unseen,
        "left_out": evaluation.pairs.left_out,
        **figure_tables.finite_values(asdict(alarms)),
        "rates": measure_rates(evaluation.scored),
        "bootstrap": {"draws": settings.draws, "seed": settings.seed},
        "overall": overall,
        "bands": bands,
        "curves": figure_tables.curves_to_json(evaluation.scored),
        "definitions": METRIC_DEFINITIONS,
        **({"paired": evaluation.paired} if evaluation.paired else {}),
        **({"boxes": [one.to_json() for one in evaluation.boxes]} if evaluation.boxes else {}),
    }


def print_evaluation(recordings: Sequence[Path], evaluation: Evaluation) -> None:
    """Print the figures, one column per band that holds labels."""
    settings = evaluation.settings
    headers, rows = figure_tables.build_band_table(
        [figure_tables.band_to_json(band) for band in evaluation.bands]
    )
    split = f", split {settings.split}" if settings.split else ""
    name = str(recordings[0]) if len(recordings) == 1 else f"{len(recordings)} recordings"
    part = ", only those with detections" if settings.partial else ""
    title = f"{name}: {evaluation.pairs.images} images against {settings.against}{split}{part}"
    pooled = comparison.is_pooled({"images": evaluation.pairs.images, "paired": evaluation.paired})
    if pooled:
        print_line(f"{title}, each by two models: below is their comparison, not their mean")
    else:
        print_table(title, ["detection minus label", *headers], rows)
    notes = [f"{why}: {count}" for why, count in evaluation.pairs.left_out.items()]
    if unmatched := evaluation.bands[0].unmatched:
        notes.append(f"labels without any detection: {unmatched}")
    for words in notes:
        print_line(f"left out: {words}")
    if unseen := evaluation.pairs.unseen:
        print_line(
            f"{unseen} images have no Detections message: nothing was found there. "
            "--partial leaves them out"
        )
    quiet = count_false_alarms(evaluation.scored, evaluation.threshold)
    if quiet.empty_images:
        print_line(
            f"nobody in view: an alarm in {quiet.alarmed_images} of {quiet.empty_images} images, "
            f"{quiet.false_alarms:.3f} an image"
        )
    if evaluation.paired:
        print_table(
            "the two on their common images",
            comparison.HEADERS,
            comparison.build_rows(evaluation.paired),
        )
        print_line(comparison.note(evaluation.paired))
    names = [str(path) for path in recordings] if evaluation.paired else [name]
    for judged, boxes in zip(names, evaluation.boxes, strict=False):
        boxes.print(judged)
    if not pooled:
        print_line(
            f"in brackets: 95 % intervals, bootstrap over images; precision, recall and F1 at "
            f"confidence {evaluation.threshold:g}, within 16 px"
        )
