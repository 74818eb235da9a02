"""Evaluate recordings: detections against labels, positions and tracks against the truth."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from dmrl import topics
from dmrl.atomic_output import atomic_folder, refuse_existing
from dmrl.errors import MissingExtra, SettingError
from dmrl.evaluation import detection_report, flights, positions, tracks
from dmrl.evaluation.detection_report import Evaluation, Spread
from dmrl.evaluation.settings import Settings
from dmrl.recording import read_summary
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_note, print_table

figures: ModuleType | None
try:
    from dmrl.evaluation import figures
except MissingExtra:
    figures = None

Document = dict[str, Any]
KINDS = {"flight": flights, "positions": positions, "tracks": tracks}
"""Modules that evaluate against true positions; both offer the same functions."""
SETTLE_S, SHORT_FLIGHT_S = 20.0, 30.0
"""Time to settle, seconds; for a flight shorter than the second, half of it."""


def evaluate_recordings(
    recordings: Sequence[Path], out: Path | None, settings: Settings, workers: int, spread: Spread
) -> Evaluation | Document:
    """Evaluate detections of all recordings together, or one recording's positions or tracks.

    Parameters
    ----------
    recordings
        With images, labels and detections; or one with true positions and tracks or estimates.
    out
        Folder to write plots and the figures to. None: nothing is written.
    settings
        Kind of results, labels, images and threshold.
    workers, spread
        Most processes that draw the intervals, and the function that runs them.

    Raises
    ------
    SettingError
        If several recordings are given of which positions or tracks are to be evaluated.
    MissingExtra
        If plots are wanted and matplotlib is not installed.
    OutputError
        If ``out`` exists.
    """
    if out is not None:
        refuse_existing(out)
        if figures is None:
            raise MissingExtra("matplotlib", "plot", "dmrl evaluate --plots")
    what = settings.what if settings.what != "auto" else _choose_kind(recordings[0])
    if what == "detections":
        evaluation = detection_report.evaluate_detections(recordings, settings, workers, spread)
        if out is not None:
            made = detection_report.describe_evaluation(recordings, evaluation)
            with _write_folder(out, "evaluation", made) as folder:
                assert figures is not None
                scored, threshold = evaluation.scored, evaluation.threshold
                figures.draw_figures(folder, evaluation.pairs, scored, settings.against, threshold)
        return evaluation
    if len(recordings) > 1:
        raise SettingError(
            f"{what} are judged one recording at a time. Name one, or give --what detections"
        )
    return _evaluate_against_truth(what, recordings[0], out, settings.settle_s)


def _choose_kind(recording: Path) -> str:
    """Return the kind of results that the last stage has written."""
    if flights.has_flown(recording):
        return "flight"
    if tracks.has_tracks_and_truth(recording):
        return "tracks"
    detected = topics.list_robots(list(read_summary(recording).topics), topics.DETECTIONS)
    return "positions" if not detected and positions.has_positions(recording) else "detections"


def _evaluate_against_truth(
    what: str, recording: Path, out: Path | None, settle_s: float | None
) -> Document:
    kind = KINDS[what]
    judged = kind.judge(recording)
    lasts_s = kind.lasts_s(judged)
    if settle_s is None:
        settle_s = SETTLE_S if lasts_s >= SHORT_FLIGHT_S else round(lasts_s / 2, 3)
    elif settle_s >= lasts_s:
        say(
            f"{recording}: nothing settles before it ends, after {lasts_s:.1f} s: give a smaller "
            "--settle-s"
        )
    made: Document = kind.document(recording, judged, settle_s)
    if out is not None:
        with _write_folder(out, what, made) as folder:
            assert figures is not None
            if what != "flight":
                figures.draw_error_plots(folder, judged)
    return made


@contextmanager
def _write_folder(out: Path, stem: str, made: Document) -> Iterator[Path]:
    """Write a folder: first the document, then the files of the block."""
    with atomic_folder(out) as folder:
        text = json.dumps(made, indent=1, allow_nan=False)
        (folder / f"{stem}.json").write_text(text + "\n", encoding="utf-8")
        yield folder


def find_module(made: Document) -> ModuleType:
    """Return the module of `KINDS` whose figures a document has."""
    return flights if "flights" in made else tracks if "robots" in made else positions


def print_document(recording: Path, made: Document) -> None:
    """Print the figures of flights and positions by pair, and of tracks by observer."""
    kind = find_module(made)
    headers = [words for _, words, _ in kind.COLUMNS]
    print_table(f"{recording}: {kind.TITLE}", [kind.EACH, *headers], kind.rows(made))
    print_note(kind.note(made))
