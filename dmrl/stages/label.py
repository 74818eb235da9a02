"""``dmrl label``: where every robot's peers are, from ranges and odometry, as labels."""

import heapq
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from cyclopts import Parameter, validators
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import MissingExtra, RecordingError
from dmrl.geometry import Camera
from dmrl.messages import message
from dmrl.output import refuse_existing
from dmrl.progress import say, track
from dmrl.recording import (
    RawMessage,
    RecordingWriter,
    Summary,
    copy_extras,
    provenance,
    read,
    read_raw,
    read_table,
    summary,
)
from dmrl.tables import print_json, print_table

try:
    from dmrl.estimation.estimate import GATE_M, Estimate, estimate_ekf, estimate_pairs
    from dmrl.estimation.pair import Array, Pair
    from dmrl.labelling.labels import Positions, image_labels
    from dmrl.labelling.logs import Logs, read_logs
    from dmrl.labelling.report import PairReport, pair_report
except ModuleNotFoundError as e:
    raise MissingExtra(str(e.name), "label", "dmrl label") from e

POSITION_HZ = 20.0
SOURCE = "estimate"
PAIRS_AT_ONCE = 15
"""Pairs that are filtered side by side: more are no faster, and need more memory."""

Times = NDArray[np.int64]
Names = tuple[str, str]
Positive = Annotated[float, Parameter(validator=validators.Number(gt=0))]


@dataclass(frozen=True, slots=True)
class Settings:
    """How positions are estimated and labels made.

    Parameters
    ----------
    method
        "batch": the whole flight at once. "smoother": EKF and RTS from the best of 96 starts.
        "ekf": the published filter, online, from (0, 0, 0).
    preset
        ekf: its noise, as published for simulation or in the firmware.
    gate_m
        Largest sigma of a position that is labelled OK, metres.
    attitude_std_rad
        Standard deviation of roll and pitch, radians.
    range_offset_m
        Known offset of every range, subtracted first: an antenna delay, 0.35 m for some.
    undistorted
        The images have no lens distortion any more, whatever the calibration says.
    """

    method: Literal["batch", "smoother", "ekf"] = "batch"
    preset: Literal["published-sim", "published-firmware"] = "published-sim"
    gate_m: Positive = GATE_M
    attitude_std_rad: Positive = 0.015
    range_offset_m: float = 0.0
    undistorted: bool = False


@dataclass(frozen=True, slots=True)
class Result:
    """What came out: one report per ordered pair, labels written, and warnings."""

    pairs: list[PairReport]
    labels: int
    warnings: list[str]


class _Timed(NamedTuple):
    """A message to write."""

    time_ns: int
    topic: str
    message: Any


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
    refuse_existing(out)
    held = summary(recording)
    logs = read_logs(recording, held, settings.range_offset_m)
    if not logs.pairs:
        why = "; ".join(logs.warnings) or "there are no ranges"
        raise RecordingError(f"{recording}: no pair can be estimated: {why}. Try: dmrl info")
    estimates = _estimates(logs.pairs, settings)
    images = {robot: _times(recording, topics.camera_image(robot), held) for robot in logs.robots}
    positions = {
        pair: _positions(logs.start_ns, _oriented(logs.pairs, pair), estimate, images[pair[0]])
        for pair, estimate in estimates.items()
    }
    reports = [
        pair_report(recording, held, pair, positions[pair], estimates[pair]) for pair in positions
    ]
    fresh = [_position_messages(*pair, found) for pair, found in positions.items()]
    labelled: list[int] = []
    for robot in logs.robots:
        if len(images[robot]):
            mine = {peer: found for (one, peer), found in positions.items() if one == robot}
            made = list(_label_messages(recording, held, logs, robot, mine, settings))
            labelled.append(sum(p.source == SOURCE for m in made for p in m.message.peers))
            fresh.append(iter(made))
    _write(recording, held, out, fresh, images, settings)
    return Result(reports, sum(labelled), logs.warnings)


def _oriented(pairs: Mapping[Names, Pair], pair: Names) -> Pair:
    return pairs[pair] if pair in pairs else pairs[pair[::-1]].swapped()


def _estimates(
    pairs: Mapping[Names, Pair], settings: Settings
) -> dict[Names, Estimate]:
    """Of every ordered pair; the batch and the smoother solve each pair once for both."""
    names = list(pairs)
    if settings.method == "ekf":
        names += [(other, one) for one, other in names]
    groups = [names[k : k + PAIRS_AT_ONCE] for k in range(0, len(names), PAIRS_AT_ONCE)]
    out: dict[Names, Estimate] = {}
    for group in track(groups, "Estimating"):
        if settings.method == "ekf":
            oriented = [_oriented(pairs, pair) for pair in group]
            made = estimate_ekf(oriented, settings.preset, gate_m=settings.gate_m)
            out |= dict(zip(group, made, strict=True))
        else:
            chosen = [pairs[name] for name in group]
            both = estimate_pairs(chosen, settings.method, gate_m=settings.gate_m)
            for name, (here, there) in zip(group, both, strict=True):
                out[name], out[name[::-1]] = here, there
    return dict(sorted(out.items()))


def _times(recording: Path, topic: str, held: Summary) -> Times:
    if topic not in held.topics:
        return np.zeros(0, np.int64)
    return np.asarray(read_table(recording, topic, fields=())["log_time"].to_numpy())


def _positions(start_ns: int, pair: Pair, estimate: Estimate, images_ns: Times) -> Positions:
    """At 20 Hz through the flight, and at the images in it."""
    period_ns = round(1e9 / POSITION_HZ)
    first, last = (start_ns + round(float(t) * 1e9) for t in estimate.time_s[[0, -1]])
    regular = np.arange(-(-first // period_ns), last // period_ns + 1) * period_ns
    time_ns = np.union1d(regular, images_ns[(images_ns >= first) & (images_ns <= last)])
    time_s = (time_ns - start_ns) * 1e-9
    xy, spread, status = estimate.at(time_s)
    z = np.interp(time_s, pair.time_s, pair.peer.height_m - pair.own.height_m)
    covariance = np.zeros((len(time_ns), 3, 3))
    covariance[:, :2, :2] = spread
    covariance[:, 2, 2] = estimate.noise.height_std_m**2
    return Positions(time_ns, np.column_stack([xy, z]), covariance, status)


def _position_messages(observer: str, peer: str, found: Positions) -> Iterator[_Timed]:
    topic, frame = topics.position(observer, peer), f"{observer}/horizontal"
    rows = zip(found.time_ns, found.xyz_m, found.covariance, found.status, strict=True)
    for time_ns, (x, y, z), covariance, status in rows:
        fields = {"frame_id": frame, "x": x, "y": y, "z": z, "status": int(status)}
        made = message("PeerPosition")(covariance=covariance.ravel().tolist(), **fields)
        yield _Timed(int(time_ns), topic, made)


def _label_messages(
    recording: Path,
    held: Summary,
    logs: Logs,
    robot: str,
    positions: Mapping[str, Positions],
    settings: Settings,
) -> Iterator[_Timed]:
    """One per image that has a position or had labels: other sources' entries, then ours."""
    topic = topics.labels(robot)
    kept: dict[int, list[Any]] = {}
    if topic in held.topics:
        for stamped in read(recording, topic):
            others = [p for p in stamped.message.peers if p.source != SOURCE]
            kept.setdefault(stamped.time_ns, []).extend(others)
    fresh: dict[int, list[Any]] = defaultdict(list)
    camera = _camera(recording, held, robot)
    images_ns = _times(recording, topics.camera_image(robot), held)
    for peer, found in positions.items() if camera else ():
        at = np.isin(found.time_ns, images_ns)
        mine = Positions(found.time_ns[at], found.xyz_m[at], found.covariance[at], found.status[at])
        labels = image_labels(
            peer,
            mine,
            _attitude(logs, robot, mine.time_ns),
            camera,
            attitude_std_rad=settings.attitude_std_rad,
            distorted=not settings.undistorted,
        )
        for time_ns, label in zip(mine.time_ns.tolist(), labels, strict=True):
            fresh[time_ns] += [message("PeerLabel")(**label)] if label else []
    for time_ns in sorted({*kept, *fresh}):
        peers = [*kept.get(time_ns, []), *fresh.get(time_ns, [])]
        yield _Timed(time_ns, topic, message("PeerLabels")(peers=peers))


def _attitude(logs: Logs, robot: str, time_ns: Times) -> Array:
    """(N, 2) roll and pitch at log times, radians."""
    at_s, values = logs.robots[robot].attitude
    time_s = (time_ns - logs.start_ns) * 1e-9
    return np.column_stack([np.interp(time_s, at_s, column) for column in values[:, :2].T])


def _camera(recording: Path, held: Summary, robot: str) -> Camera | None:
    """A robot's camera; None, with a word, where the recording does not say."""
    topic = topics.calibration(robot)
    if topic not in held.topics:
        say(f"{recording}: no {topic}, so the images of {robot} get no labels")
        return None
    found = next(read(recording, topic)).message
    fx, _, cx, _, fy, cy, *_ = found.K
    return Camera(found.width, found.height, fx, fy, cx, cy, tuple(found.D))


def _write(
    recording: Path,
    held: Summary,
    out: Path,
    fresh: list[Iterator[_Timed]],
    images: Mapping[str, Times],
    settings: Settings,
) -> None:
    """All messages in time order, ours in place of those they replace."""
    replaced = {topics.labels(robot) for robot, times in images.items() if len(times)}
    kept = [
        topic
        for topic in held.topics
        if topic not in replaced and not topics.names(topics.POSITION, topic)
    ]
    total = sum(held.topics[topic].count for topic in kept)
    copied: Iterable[RawMessage] = track(read_raw(recording, *kept), "Writing", total)
    made = provenance("label", settings, [recording], libraries=("numpy", "scipy"))
    streams: list[Iterable[Any]] = [copied, *fresh]
    with RecordingWriter(out, made) as sink:
        copy_extras(held, sink)
        for item in heapq.merge(*streams, key=lambda m: m.time_ns):
            if isinstance(item, _Timed):
                sink.write(*item)
            else:
                sink.write_raw(item)


DEFAULTS = Settings()


def command(
    recording: Annotated[Path, Parameter(name="IN")],
    out: Path,
    /,
    *,
    settings: Annotated[Settings, Parameter(name="*")] = DEFAULTS,
    as_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> None:
    """Find every robot's peers from ranges and odometry, and label the images with them.

    Parameters
    ----------
    recording
        Recording with attitude, velocity, height and ranges.
    out
        Recording to write: all of IN, positions of peers and labels. Must not exist.
    as_json
        Print one JSON document in place of the table.
    """
    result = run(recording, out, settings)
    for warning in result.warnings:
        say(f"{recording}: {warning}")
    if as_json:
        print_json({"recording": str(out), **asdict(result)})
        return
    print_table(str(out), PairReport.columns(), [pair.row() for pair in result.pairs])
    print_table("", ("labels of images",), [(result.labels,)])
