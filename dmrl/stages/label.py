"""``dmrl label``: where every robot's peers are, from ranges and odometry, as labels."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter, validators
from numpy.typing import NDArray

from dmrl import topics
from dmrl.atomic_output import refuse_existing
from dmrl.errors import MissingExtra, MissingTopic, RecordingError, SettingError
from dmrl.messages import message
from dmrl.pipeline.batch import is_many, over_folder
from dmrl.pipeline.parallel_map import spread
from dmrl.pipeline.process_pool import cores
from dmrl.recording import Contents, Timed, provenance, rewrite
from dmrl.terminal.arguments import AsJson, Flat, In, On, Workers
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_table

try:
    from dmrl.estimation.flight.data_association import told_apart
    from dmrl.estimation.flight.pairs import estimate_ekf, estimate_pairs
    from dmrl.estimation.flight.swarm import estimate_swarm
    from dmrl.estimation.model.pair import Pair, Sightings
    from dmrl.estimation.model.status import GATE_M
    from dmrl.estimation.solver.estimate import Estimate
    from dmrl.labelling.camera_bearings import levelled, sightings_of, with_sightings
    from dmrl.labelling.ground_truth import TOLD
    from dmrl.labelling.image_labels import SOURCE, Look, Positions
    from dmrl.labelling.label_messages import label_messages, position_series
    from dmrl.labelling.observer_log import SEEN, read_sight
    from dmrl.labelling.pair_report import PairReport, pair_report, reasons
    from dmrl.labelling.recorded_camera import camera_given, camera_of
    from dmrl.labelling.sensor_file import Sensors, read_sensors
    from dmrl.labelling.sensor_logs import SENSED, Logs, read_logs
except ModuleNotFoundError as e:
    raise MissingExtra(str(e.name), "label", "dmrl label") from e

POSITION_HZ = 20.0
BESIDE = (topics.LABELS, topics.CALIBRATION, *TOLD)
"""What labels are made with, beside what positions are estimated from."""
PAIRS_AT_ONCE = 15
"""Pairs that are filtered side by side: more are no faster, and need more memory."""
LEAST_PAIRS = 4
"""Pairs for a process, at least."""
WORTH_S = 300.0
"""Seconds of flight of all pairs that are worth other processes: to begin one takes a second."""

Times = NDArray[np.int64]
Names = tuple[str, str]
Positive = Annotated[float, Parameter(validator=validators.Number(gt=0, lt=1e6))]


@dataclass(frozen=True, slots=True)
class Settings:
    """How positions are estimated and labels made.

    Parameters
    ----------
    method
        "batch": the whole flight at once, pair by pair. "swarm": then all robots together, where
        ranges connect three or more. "smoother": EKF and RTS from the best of 96 starts.
        "ekf": the published filter, online, from (0, 0, 0).
    preset
        ekf: its noise, as published for simulation or in the firmware.
    gate_m
        A position that is off by more than this is a bad one, metres. Of a flight's OK positions
        at most 4.5 % are expected to be bad; docs/labelling.md says how many were.
    attitude_std_rad
        Standard deviation of roll and pitch, radians.
    detections
        Solve with the detections that are in the recording as well, whosever they may be, wrong
        ones among them. For the method "batch".
    pixel_std_px
        Error of such a detection in u and in v, pixels.
    range_offset_m
        Known offset of every range, subtracted first: an antenna delay, 0.35 m for some.
    sensors
        What flights of these robots agree on, as dmrl calibrate --sensors wrote it.
    undistorted
        The images have no lens distortion any more, whatever the calibration says.
    copy
        With all that IN holds. --no-copy: the labels and positions alone, for which no picture is
        read; dmrl merge puts them to the others.
    camera
        A robot's camera, with mount and delay, as dmrl calibrate wrote it: --camera.cf1 FILE.
    """

    method: Literal["batch", "swarm", "smoother", "ekf"] = "batch"
    preset: Literal["published-sim", "published-firmware"] = "published-sim"
    gate_m: Positive = GATE_M
    attitude_std_rad: Positive = 0.015
    detections: bool = False
    pixel_std_px: Positive = 6.0
    range_offset_m: Annotated[float, Parameter(validator=validators.Number(gt=-60, lt=60))] = 0.0
    sensors: Path | None = None
    undistorted: bool = False
    copy: bool = True
    camera: dict[str, Path] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Result:
    """What came out: one report per ordered pair, labels written, and warnings."""

    pairs: list[PairReport]
    labels: int
    warnings: list[str]


def run(recording: Path, out: Path, settings: Settings) -> Result:
    """Copy ``recording`` to ``out`` with positions of peers, and labels of the images.

    Other messages are copied bit for bit; estimates that were there are replaced, labels from
    other sources kept.

    Parameters
    ----------
    recording
        With attitude, velocity, height and ranges of two robots or more.
    out
        Recording to write. Must not exist.
    settings
        See `Settings`.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or no pair can be estimated.
    OutputError
        If ``out`` exists.
    """
    return side_by_side(recording, out, settings, 1)


def side_by_side(recording: Path, out: Path, settings: Settings, workers: int) -> Result:
    """`run`, with pairs solved in as many processes as that; changes no byte."""
    refuse_existing(out)
    held = Contents(recording, *SENSED, *BESIDE, *(SEEN if settings.detections else ()))
    logs = _logs(held, settings)
    cameras = {robot: camera_given(held, robot, path) for robot, path in settings.camera.items()}
    look = Look(settings.attitude_std_rad, not settings.undistorted, cameras)
    sees = _sightings(held, logs, look, settings) if settings.detections else {}
    pairs = with_sightings(logs.pairs, sees)
    estimates = _estimates(pairs, settings, workers)
    if again := told_apart(pairs, estimates):
        estimates = dict(sorted((estimates | _estimates(again, settings, workers)).items()))
    images = {robot: held.times(topics.camera_image(robot)) for robot in logs.robots}
    exposures = {robot: look.exposures_ns(robot, times) for robot, times in images.items()}
    positions = {
        pair: _positions(logs.start_ns, _oriented(logs.pairs, pair), estimate, exposures[pair[0]])
        for pair, estimate in estimates.items()
    }
    for (robot, peer), found in positions.items():
        if robot in sees:
            positions[robot, peer], used = levelled(found, logs.start_ns, sees[robot])
            said = f"{used} detections in {len(sees[robot].time_s)} images counted"
            say(f"{robot} -> {peer}: {said}")
    reports = [pair_report(held, pair, positions[pair], estimates[pair]) for pair in positions]
    filming = [robot for robot, times in images.items() if len(times)]
    made = {
        robot: list(label_messages(held, logs, robot, _of(positions, robot), look))
        for robot in filming
    }
    if not settings.copy:
        made = {robot: list(_own(messages)) for robot, messages in made.items()}
    series = [position_series(*pair, found) for pair, found in positions.items()]
    replaced = [topics.labels(robot) for robot in filming]
    replaced += [topic for topic in held.topics if topics.names(topics.POSITION, topic)]
    replaced = replaced if settings.copy else list(held.topics)
    inputs = [recording, *settings.camera.values(), *filter(None, [settings.sensors])]
    origin = provenance("label", settings, inputs, libraries=("numpy", "scipy"))
    rewrite(recording, out, origin, without=replaced, fresh=made.values(), series=series)
    blind = _blind(held, filming, cameras)
    warnings = [*logs.warnings, *blind, *reasons(logs.pairs, estimates)]
    return Result(reports, _count(made.values()), warnings)


def _logs(held: Contents, settings: Settings) -> Logs:
    """Logs of all pairs, if there is a pair, and a robot for every camera file."""
    known = read_sensors(settings.sensors) if settings.sensors else Sensors()
    logs = read_logs(held, settings.range_offset_m, known)
    if settings.sensors and not set(logs.robots) & set(known.names):
        raise SettingError(
            f"{settings.sensors} is of {', '.join(known.names) or 'nobody'}, and {held.path} has "
            f"{', '.join(logs.robots) or 'nobody'}. Calibrate with flights of these robots"
        )
    if not logs.pairs:
        why = "; ".join(logs.warnings) or "there are no ranges"
        raise RecordingError(f"{held.path}: no pair can be estimated: {why}. Try: dmrl info")
    if unknown := set(settings.camera) - set(logs.robots):
        raise SettingError(f"--camera.{min(unknown)}: {held.path} has {', '.join(logs.robots)}")
    return logs


def _of(positions: Mapping[Names, Positions], robot: str) -> dict[str, Positions]:
    """Positions of its peers, by name."""
    return {peer: found for (one, peer), found in positions.items() if one == robot}


def _blind(held: Contents, filming: Iterable[str], cameras: Collection[str]) -> list[str]:
    """Warnings for robots whose images get no labels, as their camera is not known."""
    return [
        f"{robot}: no {topics.calibration(robot)}; its images get no labels. Give one: "
        f"--camera.{robot} FILE"
        for robot in filming
        if robot not in cameras and topics.calibration(robot) not in held.topics
    ]


def _own(made: Iterable[Timed]) -> Iterator[Timed]:
    """The labels made here, without those of other sources: these stay where they are."""
    for labels in made:
        if SOURCE in labels.message.sources:
            found = [peer for peer in labels.message.peers if peer.source == SOURCE]
            yield labels._replace(message=message("PeerLabels")(peers=found, sources=[SOURCE]))


def _count(made: Iterable[Iterable[Timed]]) -> int:
    """Labels made here, without those of other sources that are kept."""
    peers = (peer for messages in made for m in messages for peer in m.message.peers)
    return sum(peer.source == SOURCE for peer in peers)


def _sightings(held: Contents, logs: Logs, look: Look, settings: Settings) -> dict[str, Sightings]:
    """What the cameras of robots in pairs detected, by robot."""
    if settings.method != "batch":
        raise SettingError(f"--detections goes with --method batch, not {settings.method}")
    robots = topics.robots(list(held.topics), topics.DETECTIONS)
    if not robots:
        raise MissingTopic(topics.detections("*"), held.topics, held.path)
    out = {}
    for robot in (robot for robot in robots if robot in logs.robots):
        camera = look.cameras.get(robot) or camera_of(held, robot)
        if camera is None:
            raise MissingTopic(topics.calibration(robot), held.topics, held.path)
        if not look.distorted:
            camera = replace(camera, distortion=())
        sight = read_sight(held, robot, camera, None)
        stds = settings.pixel_std_px, settings.attitude_std_rad
        out[robot] = sightings_of(sight, logs.start_ns, *stds)
    return out


def _oriented(pairs: Mapping[Names, Pair], pair: Names) -> Pair:
    return pairs[pair] if pair in pairs else pairs[pair[::-1]].swapped()


def _estimates(
    pairs: Mapping[Names, Pair], settings: Settings, workers: int
) -> dict[Names, Estimate]:
    """Of every ordered pair; the batch and the smoother solve each pair once for both."""
    names = list(pairs)
    if settings.method == "ekf":
        names += [(other, one) for one, other in names]
    if sum(pair.time_s[-1] - pair.time_s[0] for pair in pairs.values()) < WORTH_S:
        workers = 1
    at_once = min(PAIRS_AT_ONCE, max(-(-len(names) // workers), LEAST_PAIRS))
    groups = [names[k : k + at_once] for k in range(0, len(names), at_once)]
    oriented = [[_oriented(pairs, name) for name in group] for group in groups]
    made = spread(partial(_solved, settings=settings), oriented, workers)
    out: dict[Names, Estimate] = {}
    for group in track(groups, "Estimating"):
        for name, (here, there) in zip(group, next(made), strict=True):
            out[name] = here
            if there is not None:
                out[name[::-1]] = there
    if settings.method == "swarm":
        out = estimate_swarm(pairs, out, gate_m=settings.gate_m)
    return dict(sorted(out.items()))


def _solved(pairs: list[Pair], *, settings: Settings) -> Sequence[tuple[Estimate, Estimate | None]]:
    """Of some pairs: the peer as its observer estimates it, and the other way round."""
    gate_m = settings.gate_m
    if settings.method == "ekf":
        return [(one, None) for one in estimate_ekf(pairs, settings.preset, gate_m=gate_m)]
    method: Literal["batch", "smoother"] = "smoother" if settings.method == "smoother" else "batch"
    return estimate_pairs(pairs, method, gate_m=gate_m)


def _positions(start_ns: int, pair: Pair, estimate: Estimate, images_ns: Times) -> Positions:
    """At 20 Hz through the flight, and at the images in it."""
    period_ns = round(1e9 / POSITION_HZ)
    first, last = (start_ns + round(float(t) * 1e9) for t in estimate.time_s[[0, -1]])
    regular = np.arange(-(-first // period_ns), last // period_ns + 1) * period_ns
    time_ns = np.union1d(regular, images_ns[(images_ns >= first) & (images_ns <= last)])
    time_s = (time_ns - start_ns) * 1e-9
    xy, spread, status = estimate.at(np.asarray(time_s, float))
    z = np.interp(time_s, pair.time_s, pair.peer.height_m - pair.own.height_m)
    covariance = np.zeros((len(time_ns), 3, 3))
    covariance[:, :2, :2] = spread
    covariance[:, 2, 2] = estimate.noise.height_std_m**2
    return Positions(time_ns, np.column_stack([xy, z]), covariance, status)


DEFAULTS = Settings()


def command(
    recording: In,
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Find every robot's peers from ranges and odometry, and label the images with them.

    Parameters
    ----------
    recording
        Recording with attitude, velocity, height and ranges; or a folder of recordings.
    out
        Recording to write: all of IN, positions of peers and labels. Must not exist. For a
        folder: the folder of what is made, under the same names.
    workers
        Recordings of a folder, or pairs of robots of one, at a time, at most. Without it, as many
        as there are cores. Changes no byte.
    as_json
        Print one JSON document in place of the table.
    """
    if is_many(recording) or on is not None:
        over_folder("label", recording, out, settings, workers=workers, on=on, as_json=as_json)
        return
    result = side_by_side(recording, out, settings, workers or cores())
    for warning in result.warnings:
        say(f"{recording}: {warning}")
    if as_json:
        print_json({"recording": str(out), **asdict(result)})
        return
    print_table(str(out), PairReport.columns(), [pair.row() for pair in result.pairs])
    print_table("", ("labels of images",), [(result.labels,)])
