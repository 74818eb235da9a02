"""``dmrl evaluate``: detections against labels; positions and tracks against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, validators

from dmrl.guards.posix import count_cores
from dmrl.pipeline.batch import find_all_recordings
from dmrl.pipeline.parallel_map import parallel_map
from dmrl.pipeline.single_run import run_on_cluster
from dmrl.terminal.arguments import AsJson, Count, Flat, On, Share, Workers
from dmrl.terminal.tables import print_json, print_line

if TYPE_CHECKING:
    from dmrl.evaluation.detection_report import Evaluation

Finite = Annotated[float | None, Parameter(validator=validators.Number(gte=0, lt=1e6))]


@dataclass(frozen=True, slots=True)
class Settings:
    """Kind of results, labels, images and threshold of an evaluation.

    Parameters
    ----------
    what
        "auto": flight where a pilot flew a robot, tracks where there are any with true positions,
        else detections, else estimated positions. flight: seconds held, contacts, silent stretches
        and alarms over time.
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
        positions, tracks: errors in the first seconds do not count, except for kept positions.
        Without it, 20 s, or half of a flight under 30 s.
    """

    what: Literal["auto", "detections", "flight", "positions", "tracks"] = "auto"
    against: Literal["truth", "estimate", "hand", "published"] = "truth"
    split: str | None = None
    partial: Annotated[bool, Parameter(negative=())] = False
    threshold: Share | None = None
    false_alarms: Finite = None
    draws: Count = 1000
    seed: int = 0
    settle_s: Finite = None


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
    from dmrl.evaluation.detection_report import DetectionCriteria
    from dmrl.evaluation.evaluate_recordings import evaluate_recordings

    criteria = DetectionCriteria(
        **{one.name: getattr(settings, one.name) for one in fields(DetectionCriteria)}
    )
    what, settle_s = settings.what, settings.settle_s
    return evaluate_recordings(recordings, out, what, criteria, settle_s, workers, parallel_map)


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
