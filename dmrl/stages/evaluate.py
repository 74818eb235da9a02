"""``dmrl evaluate``: detections against labels; positions and tracks against the truth."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

from cyclopts import Parameter, validators

from dmrl import topics
from dmrl.atomic_output import partial_folder, refuse_existing
from dmrl.errors import MissingExtra, SettingError
from dmrl.evaluation import positions, tracks
from dmrl.evaluation.detections import Pairs, join
from dmrl.evaluation.figure_tables import band_values, by_band_table, curve_values, finite
from dmrl.learn.inference.detection_metrics import DEFINITIONS, BandFigures, Scored, by_band, score
from dmrl.learn.inference.threshold import LEAST_EMPTY, LEAST_LABELS, alarms, best_threshold
from dmrl.pipeline.batch import all_recordings
from dmrl.pipeline.parallel_map import spread
from dmrl.pipeline.process_pool import cores
from dmrl.pipeline.single_run import done_on
from dmrl.recording import input_of, summary
from dmrl.terminal.arguments import AsJson, Flat, On, Workers
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_json, print_line, print_table

figures: ModuleType | None
try:
    from dmrl.evaluation import figures
except MissingExtra:
    figures = None

Document = dict[str, Any]
KINDS = {"positions": positions, "tracks": tracks}
"""What can be judged by true positions; both modules offer the same functions."""
SETTLE_S, SHORT_S = 20.0, 30.0
"""Time to settle; of what is shorter than this, the first half is."""
WORTH_DRAWING = 2_000_000
"""Images times draws from which processes gain more than they take to begin."""
FALLBACK_THRESHOLD = 0.33  # the published evaluation's, for detectors that name none
Finite = Annotated[float | None, Parameter(validator=validators.Number(gte=0, lt=1e6))]


@dataclass(frozen=True, slots=True)
class Settings:
    """What is judged, against what, and how.

    Parameters
    ----------
    what
        "auto": tracks where there are any with true positions, else detections, else estimated
        positions.
    against
        Whose labels.
    split
        Only images of this split of the recording's source, such as test. Without it, all.
    partial
        Judge only images that have a Detections message. Without it, one without counts as an
        image in which nothing was found.
    threshold
        Confidence from which a detection counts in precision, recall and F1, 0 to 1. Without
        it, the one in the recording.
    false_alarms
        Choose the threshold on these images: that of the best F1 among those at which an image
        without a robot has at most so many detections, on average, such as 0.05.
    draws
        Bootstrap samples behind the 95 % intervals.
    seed
        Of the bootstrap.
    settle_s
        positions, tracks: errors in the first seconds do not count, but for what is kept.
        Without it, 20 s, or half of a flight under 30 s.
    """

    what: Literal["auto", "detections", "positions", "tracks"] = "auto"
    against: Literal["truth", "estimate", "hand", "published"] = "truth"
    split: str | None = None
    partial: Annotated[bool, Parameter(negative=())] = False
    threshold: Annotated[float | None, Parameter(validator=validators.Number(gte=0, lte=1))] = None
    false_alarms: Finite = None
    draws: Annotated[int, Parameter(validator=validators.Number(gte=1))] = 1000
    seed: int = 0
    settle_s: Finite = None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A judged recording.

    Parameters
    ----------
    pairs
        Labels and detections.
    scored
        The same, matched.
    bands
        Figures over all distances, then by band.
    threshold
        The one that was used.
    """

    pairs: Pairs
    scored: Scored
    bands: list[BandFigures]
    threshold: float


def run(
    recordings: Sequence[Path], out: Path | None, settings: Settings, *, workers: int = 1
) -> Evaluation | Document:
    """Judge detections together, or one recording's positions or tracks: then as JSON values.

    Parameters
    ----------
    recordings
        With images, labels and detections; or one with true positions and tracks or estimates.
    out
        Folder to write plots and ``evaluation.json``, ``positions.json`` or ``tracks.json`` to.
        None: nothing is written.
    settings
        See `Settings`.
    workers
        Processes that draw the intervals, at most; changes no byte.

    Raises
    ------
    RecordingError
        If a recording cannot be read, or has nothing to judge, or nothing to judge it by.
    SettingError
        If one has no labels of that source, no such split, or no image to judge; if several are
        given of which positions or tracks are to be judged.
    MissingExtra
        If plots are wanted and matplotlib is not installed.
    OutputError
        If ``out`` exists.
    """
    if out is not None:
        refuse_existing(out)
        if figures is None:
            raise MissingExtra("matplotlib", "plot", "dmrl evaluate --plots")
    what = settings.what if settings.what != "auto" else _what(recordings[0])
    if what == "detections":
        return run_detections(recordings, out, settings, workers)
    if len(recordings) > 1:
        raise SettingError(
            f"{what} are judged one recording at a time. Name one, or give --what detections"
        )
    return _run_document(KINDS[what], f"{what}.json", recordings[0], out, settings.settle_s)


def _what(recording: Path) -> str:
    """What the last stage that wrote anything worth judging has written."""
    if tracks.can_judge(recording):
        return "tracks"
    detected = topics.robots(list(summary(recording).topics), topics.DETECTIONS)
    return "positions" if not detected and positions.has_positions(recording) else "detections"


def _run_document(
    kind: ModuleType, name: str, recording: Path, out: Path | None, settle_s: float | None
) -> Document:
    judged = kind.judge(recording)
    lasts_s = kind.lasts_s(judged)
    if settle_s is None:
        settle_s = SETTLE_S if lasts_s >= SHORT_S else round(lasts_s / 2, 3)
    elif settle_s >= lasts_s:
        say(
            f"{recording}: nothing settles before it ends, after {lasts_s:.1f} s: give a smaller "
            "--settle-s"
        )
    made: Document = kind.document(recording, judged, settle_s)
    if out is not None:
        with _folder(out, name, made) as folder:
            assert figures is not None
            figures.draw_errors(folder, judged)
    return made


@contextmanager
def _folder(out: Path, name: str, made: Document) -> Iterator[Path]:
    """A folder that gets the document first, and its name when all is in it."""
    with partial_folder(out) as folder:
        text = json.dumps(made, indent=1, allow_nan=False)
        (folder / name).write_text(text + "\n", encoding="utf-8")
        yield folder


def run_detections(
    recordings: Sequence[Path], out: Path | None, settings: Settings, workers: int = 1
) -> Evaluation:
    """Judge the detections of all recordings, image by image; see `run`."""
    pairs = join(recordings, settings.against, settings.split, partial=settings.partial)
    scored = score(pairs.images, pairs.labels, pairs.detections)
    threshold = _threshold(scored, pairs, settings)
    if pairs.images * settings.draws < WORTH_DRAWING:
        workers = 1
    bands = by_band(
        scored,
        threshold=threshold,
        draws=settings.draws,
        seed=settings.seed,
        across=partial(spread, workers=workers),
    )
    evaluation = Evaluation(pairs, scored, bands, threshold)
    if out is not None:
        made = document(recordings, settings, evaluation)
        with _folder(out, "evaluation.json", made) as folder:
            assert figures is not None
            figures.draw(folder, pairs, scored, settings.against, threshold)
    return evaluation


def _threshold(scored: Scored, pairs: Pairs, settings: Settings) -> float:
    """The one that is asked for, that keeps to the rate of false alarms, or the detector's own."""
    if settings.false_alarms is None:
        own = pairs.threshold or FALLBACK_THRESHOLD
        return own if settings.threshold is None else settings.threshold
    if settings.threshold is not None:
        raise SettingError("--threshold and --false-alarms are two answers. Give one of them")
    empty = alarms(scored, 0.0).empty_images
    chosen = best_threshold(scored, settings.false_alarms)
    if chosen is None or empty < LEAST_EMPTY:
        raise SettingError(
            f"--false-alarms wants {LEAST_LABELS} labels, some of them found, and {LEAST_EMPTY} "
            f"images without a robot: there are {len(scored.labels)} and {empty}. Give --threshold"
        )
    return chosen


def document(
    recordings: Sequence[Path], settings: Settings, evaluation: Evaluation
) -> dict[str, Any]:
    """Everything that was measured, as JSON values; null where there was nothing to measure.

    One recording is ``recording``, several are ``recordings``.
    """
    sources = [{"name": s.name, "sha256": s.sha256} for s in map(input_of, recordings)]
    overall, *bands = [band_values(band) for band in evaluation.bands]
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
        **{
            name: finite(value)
            for name, value in asdict(alarms(evaluation.scored, evaluation.threshold)).items()
        },
        "bootstrap": {"draws": settings.draws, "seed": settings.seed},
        "overall": overall,
        "bands": bands,
        "curves": curve_values(evaluation.scored),
        "definitions": DEFINITIONS,
    }


def print_evaluation(
    recordings: Sequence[Path], settings: Settings, evaluation: Evaluation
) -> None:
    """Print the figures, one column per band that holds labels."""
    headers, rows = by_band_table(evaluation.bands)
    split = f", split {settings.split}" if settings.split else ""
    name = str(recordings[0]) if len(recordings) == 1 else f"{len(recordings)} recordings"
    part = ", only those with detections" if settings.partial else ""
    title = f"{name}: {evaluation.pairs.images} images against {settings.against}{split}{part}"
    print_table(title, ["label minus detection", *headers], rows)
    notes = [f"{count} {why}" for why, count in evaluation.pairs.left_out.items()]
    if unmatched := evaluation.bands[0].unmatched:
        notes.append(f"{unmatched} labels without any detection")
    for note in notes:
        print_line(f"left out: {note}")
    if unseen := evaluation.pairs.unseen:
        print_line(
            f"{unseen} images have no Detections message: nothing was found there. "
            "--partial leaves them out"
        )
    quiet = alarms(evaluation.scored, evaluation.threshold)
    if quiet.empty_images:
        print_line(
            f"nobody in view: an alarm in {quiet.alarmed_images} of {quiet.empty_images} images, "
            f"{quiet.false_alarms:.3f} an image"
        )
    print_line(
        f"in brackets: 95 % intervals, bootstrap over images; precision, recall and F1 at "
        f"confidence {evaluation.threshold:g}, within 16 px"
    )


def print_document(recording: Path, made: Document) -> None:
    """Print the figures of positions, one row per pair, or of tracks, one per observer."""
    kind = tracks if "robots" in made else positions
    headers = [words for _, words, _ in kind.COLUMNS]
    print_table(f"{recording}: {kind.TITLE}", [kind.EACH, *headers], kind.rows(made))
    print_line(kind.note(made))


DEFAULTS = Settings()


def command(
    recordings: Annotated[list[Path], Parameter(name="IN")],
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    plots_to: Annotated[Path | None, Parameter(name="--plots")] = None,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Judge detections against labels; tracks and positions against the truth.

    Parameters
    ----------
    recordings
        Recordings with images, labels and detections, or folders of them, judged together; or
        one with true positions and tracks or estimates.
    plots_to
        Folder to write plots to, and evaluation.json, positions.json or tracks.json. Must not
        exist.
    workers
        Processes that draw the intervals, at most. Without it, as many as there are cores.
        Changes no byte.
    as_json
        Print one JSON document in place of the table.
    """
    recordings = all_recordings(recordings)
    if on is not None:
        done_on(on, "evaluate", plots_to, {"recordings": recordings}, settings)
        print_line(f"{plots_to}: figures and their document")
        return
    evaluation = run(recordings, plots_to, settings, workers=workers or cores())
    if isinstance(evaluation, dict):
        if as_json:
            print_json(evaluation)
        else:
            print_document(recordings[0], evaluation)
    elif as_json:
        print_json(document(recordings, settings, evaluation))
    else:
        print_evaluation(recordings, settings, evaluation)
