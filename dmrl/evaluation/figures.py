"""Draw the figures of an evaluation: error plots, and a few example images."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dmrl import plots, topics
from dmrl.colours import MIN_DEPTH_CONFIDENCE
from dmrl.estimation.model.position_metrics import ErrorTrace
from dmrl.evaluation.detections import ImageKey, LabelledDetections
from dmrl.guards.safe_names import safe_join
from dmrl.images.codec import decode
from dmrl.learn.inference.detection_metrics import ScoredDetections
from dmrl.plots import Example, GalleryImage
from dmrl.recording import read, read_summary

Array = NDArray[np.float64]

HIT_QUANTILES, MISS_QUANTILES = (0.5, 0.95), (0.25, 0.75)
"""Quantiles of hits by distance, and of misses in their order, at which examples are drawn."""
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
        Detections below this confidence are not drawn over images.
    """
    error, depth_m = scored.label_error, scored.labels.depth_m
    plots.plot_error_violins(error.u_px, error.v_px, error.depth_m, folder / "error-violins")
    plots.plot_error_by_distance(
        depth_m, error.norm_px, error.depth_m, folder / "error-by-distance"
    )
    outcomes = _Outcomes.of(scored, threshold)
    shown = [
        _build_example(pairs, image, outcomes.describe(image), source, threshold)
        for image in outcomes.choose()
    ]
    if shown:
        plots.plot_examples(shown, folder / "examples")
    if pairs.images:
        plots.plot_gallery(_choose_gallery(pairs, threshold), folder / "circles")


def _choose_gallery(pairs: LabelledDetections, threshold: float) -> list[GalleryImage]:
    """Return images evenly spread over all, with their detections above the threshold."""
    places = np.linspace(0, pairs.images - 1, GALLERY_IMAGES + 2)[1:-1].astype(int)
    mine = pairs.detections.select(pairs.detections.confidence >= threshold)
    shown = []
    for image in np.unique(places).tolist():
        found, at = mine.select(mine.image == image), pairs.at[image]
        title = f"{at.recording.stem}, {_format_time(at)}"
        uv_px = np.column_stack([found.u_px, found.v_px])
        shown.append(GalleryImage(title, read_image(at), uv_px, found.depth_m))
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


@dataclass(frozen=True, slots=True)
class _Outcomes:
    """Outcome of each image at a threshold, (N,).

    Parameters
    ----------
    hit_px
        Largest distance of a correct detection from its label; -1: no hit.
    missed
        Number of labels without a correct detection.
    false_confidence
        Largest confidence of a false detection; 0: none.
    """

    hit_px: Array
    missed: NDArray[np.int64]
    false_confidence: Array

    @staticmethod
    def of(scored: ScoredDetections, threshold: float) -> "_Outcomes":
        """Classify labels and detections as the metrics do."""
        labels, found, right = scored.labels, scored.detections, scored.right_16_px
        sure = found.confidence >= threshold
        (hits,) = np.nonzero(sure & (right >= 0))
        of = right[hits]
        off_px = np.hypot(found.u_px[hits] - labels.u_px[of], found.v_px[hits] - labels.v_px[of])
        hit_px, false_confidence = np.full(scored.images, -1.0), np.zeros(scored.images)
        np.maximum.at(hit_px, found.image[hits], off_px)
        wrong = found.select(sure & (right < 0))
        np.maximum.at(false_confidence, wrong.image, wrong.confidence)
        missed = np.bincount(np.delete(labels.image, of), minlength=scored.images)
        return _Outcomes(hit_px, missed, false_confidence)

    def choose(self) -> list[int]:
        """Return images with a hit only, with a miss, and with a false detection, two of each.

        Hits are typical and poor ones; misses are spread over the images; the most confident false
        detections come first.
        """
        spoilt = (self.missed > 0) | (self.false_confidence > 0)
        good = np.flatnonzero((self.hit_px >= 0) & ~spoilt)
        good = good[np.argsort(self.hit_px[good], kind="stable")]
        missed, false = np.flatnonzero(self.missed), np.flatnonzero(self.false_confidence)
        chosen = [*_take_at(good, HIT_QUANTILES), *_take_at(missed, MISS_QUANTILES)]
        false = np.setdiff1d(false, chosen)
        false = false[np.argsort(-self.false_confidence[false], kind="stable")]
        return [*chosen, *false[:2].tolist()]

    def describe(self, image: int) -> str:
        """Return the outcome of an image in words."""
        words = [f"hit: {self.hit_px[image]:.1f} px"] * bool(self.hit_px[image] >= 0)
        words += ["miss"] * bool(self.missed[image])
        confidence = self.false_confidence[image]
        words += [f"false detection: confidence {confidence:.2f}"] * bool(confidence > 0)
        return ", ".join(words)


def _take_at(images: NDArray[np.intp], shares: Sequence[float]) -> list[int]:
    """Return the images at these quantiles of their order, each once."""
    places = {round(share * (len(images) - 1)): None for share in shares if len(images)}
    return [int(images[place]) for place in places]


def _build_example(
    pairs: LabelledDetections, image: int, outcome: str, source: str, threshold: float
) -> Example:
    at = pairs.at[image]
    recording, robot, time_ns = at
    maps = _read_maps(recording, robot, time_ns)
    labels = pairs.labels.select(pairs.labels.image == image)
    found = pairs.detections
    found = found.select((found.image == image) & (found.confidence >= threshold))
    several = len({at.recording for at in pairs.at}) > 1
    return Example(
        title=f"{recording.stem}, " * several + f"{_format_time(at)}, {outcome}",
        rgb=read_image(at),
        confidence=maps["confidence"],
        depth_m=np.where(maps["confidence"] >= MIN_DEPTH_CONFIDENCE, maps["depth_m"], np.nan),
        labels_px=np.column_stack([labels.u_px, labels.v_px]),
        detections_px=np.column_stack([found.u_px, found.v_px]),
        source=source,
    )


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
