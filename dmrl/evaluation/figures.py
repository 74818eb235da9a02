"""Draw the figures of an evaluation: error plots, and a few example images."""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dmrl import plots, topics
from dmrl.estimation.model.position_metrics import ErrorTrace
from dmrl.evaluation.detections import ImageKey, LabelledDetections
from dmrl.guards.safe_names import safe_join
from dmrl.images.codec import decode
from dmrl.learn.inference.detection_metrics import SCORE_RADIUS_PX, ScoredDetections
from dmrl.learn.inference.matching import Points
from dmrl.plots import Example, GalleryImage
from dmrl.recording import read, read_summary

Array = NDArray[np.float64]

EXAMPLE_QUANTILES = (0.2, 0.5, 0.8, 0.95)
"""Quantiles of the error at which examples are drawn: typical images, and the tail."""

MAX_ERROR_PLOTS = 12
"""Pairs or observers whose errors are plotted, at most."""
GALLERY_IMAGES = 6
"""Images in the figure with circles."""


class HasErrors(Protocol):
    """Estimated or tracked positions with their errors against the truth."""

    @property
    def trace(self) -> ErrorTrace:
        """Errors over time."""


def draw_error_plots(folder: Path, judged: Sequence[HasErrors]) -> None:
    """Write error plots of the first `MAX_ERROR_PLOTS` pairs or observers into a folder.

    One without a known error, such as an observer that never had a peer in view, has no plot.
    """
    traces = (one.trace for one in judged)
    known = (t for t in traces if any(np.isfinite(e).any() for e in t.errors_m.values()))
    for trace in islice(known, MAX_ERROR_PLOTS):
        stem = safe_join(folder, trace.name, "a trace")
        plots.plot_error_trace(trace.title, trace.time_s, trace.sigma_m, trace.errors_m, stem)


def draw_figures(
    folder: Path, pairs: LabelledDetections, scored: ScoredDetections, source: str, threshold: float
) -> None:
    """Write every figure of an evaluation of detections into a folder.

    Parameters
    ----------
    folder
        Receives error-violins, error-by-distance, examples and circles, as PNG and SVG.
    pairs
        Labels and detections of the evaluated images.
    scored
        The same labels and detections, matched.
    source
        Source of the labels.
    threshold
        Detections below this confidence are drawn over images only if a label is matched with them.
    """
    error, depth_m = scored.label_error, scored.labels.depth_m
    plots.plot_error_violins(error.u_px, error.v_px, error.depth_m, folder / "error-violins")
    plots.plot_error_by_distance(
        depth_m, error.norm_px, error.depth_m, folder / "error-by-distance"
    )
    if shown := _choose_examples(pairs, error.norm_px, source, threshold):
        plots.plot_examples(shown, folder / "examples")
    if pairs.images:
        plots.plot_gallery(_choose_gallery(pairs, threshold), folder / "circles")


def _choose_gallery(pairs: LabelledDetections, threshold: float) -> list[GalleryImage]:
    """Return images evenly spread over all, with their detections above the threshold."""
    places = np.unique(
        np.linspace(0, pairs.images - 1, GALLERY_IMAGES + 2)[1:-1].astype(int)
    ).tolist()
    mine = pairs.detections.select(pairs.detections.confidence >= threshold)
    shown = []
    for image in places:
        found = mine.select(mine.image == image)
        at = pairs.at[image]
        shown.append(
            GalleryImage(
                f"{at.recording.stem}, {_format_time(at)}",
                read_image(at),
                np.column_stack([found.u_px, found.v_px]),
                found.depth_m,
            )
        )
    return shown


def _format_time(at: ImageKey) -> str:
    """Return the time of an image in the form of ``dmrl view --time``."""
    return f"{(at.time_ns - read_summary(at.recording).start_ns) / 1e9:.2f} s"


def read_image(at: ImageKey) -> NDArray[np.uint8]:
    """Read and decode an image."""
    recording, robot, time_ns = at
    topic = topics.CAMERA_IMAGE(robot)
    taken = next(read(recording, topic, start_ns=time_ns, end_ns=time_ns + 1))
    return decode(taken.message.data, what=f"{recording}: {topic} at {time_ns} ns")


def _choose_examples(
    pairs: LabelledDetections, error_px: Array, source: str, threshold: float
) -> list[Example]:
    """Return the images at fixed quantiles of their largest label error, best first."""
    worst_px = np.full(pairs.images, -1.0)
    np.maximum.at(worst_px, pairs.labels.image, error_px)
    labelled = np.flatnonzero(worst_px >= 0)
    order = labelled[np.argsort(worst_px[labelled], kind="stable")]
    places = dict.fromkeys(
        int(share * (len(order) - 1)) for share in EXAMPLE_QUANTILES if len(order)
    )
    return [
        _build_example(pairs, order[place], worst_px[order[place]], source, threshold)
        for place in places
    ]


def _build_example(
    pairs: LabelledDetections, image: int, worst_px: float, source: str, threshold: float
) -> Example:
    at = pairs.at[image]
    recording, robot, time_ns = at
    rgb = read_image(at)
    maps = _read_maps(recording, robot, time_ns)
    labels = pairs.labels.select(pairs.labels.image == image)
    labels_px = np.column_stack([labels.u_px, labels.v_px])
    several = len({at.recording for at in pairs.at}) > 1
    return Example(
        title=f"{recording.stem}, " * several + f"{_format_time(at)}, {_describe_error(worst_px)}",
        rgb=rgb,
        confidence=maps["confidence"],
        depth_m=maps["depth_m"],
        labels_px=labels_px,
        detections_px=_select_detections(pairs.detections, image, len(labels_px), threshold),
        source=source,
    )


def _describe_error(error_px: float) -> str:
    """Return the error of an image's worst label in words, and whether it is a failure."""
    if not np.isfinite(error_px):
        return "failure: a label without a detection"
    failure = f"failure: over {SCORE_RADIUS_PX:g} px, " if error_px > SCORE_RADIUS_PX else ""
    return f"{failure}error {error_px:.1f} px"


def _read_maps(recording: Path, robot: str, time_ns: int) -> dict[str, Array]:
    """Read the grid maps by channel; all NaN if the recording has none."""
    out = {name: np.full((1, 1), np.nan) for name in ("confidence", "depth_m")}
    if topics.GRID(robot) in read_summary(recording).topics:
        for _, maps in iter_maps(recording, robot, start_ns=time_ns, end_ns=time_ns + 1):
            out.update(maps)
    return out


def iter_maps(recording: Path, robot: str, **span: int) -> Iterator[tuple[int, dict[str, Array]]]:
    """Yield log time and the grid maps by channel; ``span`` as `dmrl.recording.read`."""
    for stamped in read(recording, topics.GRID(robot), **span):
        grid = stamped.message
        shape = (len(grid.channels), grid.rows, grid.cols)
        values = np.frombuffer(grid.data, "<f4").reshape(shape).astype(float)
        yield stamped.time_ns, dict(zip(grid.channels, values, strict=True))


def _select_detections(points: Points, image: int, least: int, threshold: float) -> Array:
    """Return the pixels of detections above the threshold or among the first ``least``."""
    mine = points.select(points.image == image)
    mine = mine.select((mine.confidence >= threshold) | (np.arange(len(mine)) < least))
    return np.column_stack([mine.u_px, mine.v_px])
