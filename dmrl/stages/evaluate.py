"""``dmrl evaluate``: detections against labels; positions and tracks against the truth."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from dmrl.evaluation.settings import Settings
from dmrl.guards.posix import count_cores
from dmrl.pipeline.batch import find_all_recordings
from dmrl.pipeline.parallel_map import parallel_map
from dmrl.pipeline.single_run import run_on_cluster
from dmrl.terminal.arguments import AsJson, Flat, On, Workers
from dmrl.terminal.tables import print_json, print_line

if TYPE_CHECKING:
    from dmrl.evaluation.detection_report import Evaluation


def run(
    recordings: Sequence[Path], out: Path | None, settings: Settings, *, workers: int = 1
) -> "Evaluation | dict[str, Any]":
    """Evaluate detections together, or one recording's positions or tracks: then as JSON values.

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
    from dmrl.evaluation.evaluate_recordings import evaluate_recordings

    return evaluate_recordings(recordings, out, settings, workers, parallel_map)


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
    """Evaluate detections against labels; tracks and positions against the truth.

    Parameters
    ----------
    recordings
        Recordings with images, labels and detections, or folders of them, judged together; two
        with the same images are compared too. Or one with true positions and tracks or estimates.
    plots_to
        Folder to write plots to, and evaluation.json, positions.json or tracks.json. Must not
        exist.
    workers
        Processes that draw the intervals, at most. Without it, as many as there are cores.
        Does not affect the output.
    """
    recordings = find_all_recordings(recordings)
    if on is not None:
        run_on_cluster(on, "evaluate", plots_to, {"recordings": recordings}, settings)
        print_line(f"{plots_to}: figures and their document")
        return
    from dmrl.evaluation.detection_report import describe_evaluation, print_evaluation
    from dmrl.evaluation.evaluate_recordings import print_document

    evaluation = run(recordings, plots_to, settings, workers=workers or count_cores())
    if isinstance(evaluation, dict):
        if as_json:
            print_json(evaluation)
        else:
            print_document(recordings[0], evaluation)
    elif as_json:
        print_json(describe_evaluation(recordings, evaluation))
    else:
        print_evaluation(recordings, evaluation)
