"""Conversion of Crazyflie log variables to dmrl's units, signs and topics.

Every block is kept as it was logged, on ``/<robot>/log/<block>``. In addition, these quantities
are derived from it, on dmrl's own topics:

* attitude, from ``stateEstimate.q*``, ``stateEstimateZ.quat``, or ``stateEstimate``, else
  ``stabilizer`` ``.roll .pitch .yaw`` (degrees, pitch positive nose up: negated here);
* its yaw rate about the vertical, from ``gyro.*`` (degrees per second, body axes);
* velocity, from ``stateEstimate.v*``: in the frame of take-off, rotated by -yaw, for which
  roll and pitch need not be logged;
* height, from ``stateEstimate.z``, else ``range.zrange`` (millimetres along the body's z);
* ranges, from ``ranging.distanceN`` (metres as a float, millimetres as an integer, or as
  whole numbers too large for metres) and the event ``estDistance``;
* pose and true pose, from ``stateEstimate`` and ``locSrv`` (motion capture).

If attitude or velocity cannot be derived, one line reports the missing variables.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.formats.clocks import find_new_values, settle_times
from dmrl.formats.crazyflie.log_block import LogBlock, TimeSeries, find_series
from dmrl.formats.crazyflie.state import (
    ANGLES,
    compute_yaw_rate,
    find_angle,
    find_attitude,
    find_in_metres,
    find_orientation,
    find_quaternions,
)
from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import quaternion_to_euler
from dmrl.messages import LogType
from dmrl.samples import flight
from dmrl.samples.flight import RobotPose, Times
from dmrl.samples.sample import Columns, Sample
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say

MAX_RANGE_M = 60.0
MAX_ZRANGE_MM = 8000.0  # the sensor reports values such as 32766 where it detects no floor
TF_PERIOD_NS = 50_000_000
DISTANCE_VARIABLE = re.compile(r"ranging\.distance(\d+)")

KNOWN_GROUPS = ("stateEstimate", "stabilizer.", "gyro.", "range.", "ranging.", "locSrv.")
"""Beginnings of the names of variables that dmrl's own topics are derived from."""

SampleStream = Iterable[Sample]


def build_streams(
    robot: str, blocks: Sequence[LogBlock], names: Mapping[str, str], where: object = "the log"
) -> list[SampleStream]:
    """Build the sample streams of a robot's log, each in time order.

    Parameters
    ----------
    robot
        Its name.
    blocks
        Its log blocks.
    names
        Names of the robots that it ranges to, by their number; others are ``cf<number>``.
    where
        The source, for warnings.

    Raises
    ------
    SourceError
        If the clock of the log starts again.
    """
    blocks = [_settle_block(block, where) for block in blocks]
    _count_not_finite(blocks, where)
    _report_missing(robot, blocks, where)
    logged = [build_raw_stream(robot, block) for block in blocks]
    return logged + derive_streams(robot, blocks, names, where)


def derive_streams(
    robot: str, blocks: Sequence[LogBlock], names: Mapping[str, str], where: object
) -> list[SampleStream]:
    """Derive dmrl's own topics from blocks in time order; see the module."""
    found: list[SampleStream] = []
    attitude = find_attitude(blocks)
    if attitude is not None:
        found.append(_build_attitude(robot, attitude, compute_yaw_rate(blocks, attitude)))
    found += _iter_motion_streams(robot, blocks, attitude)
    found += iter_range_streams(robot, blocks, names, where)
    found += _iter_pose_streams(robot, blocks)
    return found


def _count_not_finite(blocks: Sequence[LogBlock], where: object) -> None:
    """Count the values of known variables that are not finite, which only the raw log keeps."""
    for block in blocks:
        for name, values in block.columns.items():
            if name.startswith(KNOWN_GROUPS) and values.dtype.kind == "f":
                count = int((~np.isfinite(values)).sum())
                leave_out(f"values of {name} that are not finite", where, count)


def _settle_block(block: LogBlock, where: object) -> LogBlock:
    def name_row(row: int) -> str:
        return f"{where}: {block.name}, record {row + 1}"

    found = settle_times(block.time_ns, name_row)
    if len(found.rows) == len(block.time_ns) and (np.diff(found.rows) == 1).all():
        return replace(block, time_ns=found.time_ns)
    columns = {name: values[found.rows] for name, values in block.columns.items()}
    return replace(block, time_ns=found.time_ns, columns=columns)


def build_raw_stream(robot: str, block: LogBlock) -> SampleStream:
    """Build the stream of a block's variables, exactly as they were logged."""
    codes = {name: values.dtype.char.replace("l", "i") for name, values in block.columns.items()}
    kind = LogType(block.name, tuple(codes.items()))
    topic = topics.LOG(robot, re.sub(r"[^A-Za-z0-9_-]", "_", block.name))
    fields = dict(zip(kind.fields, block.columns.values(), strict=True))
    return Columns(topic, kind, block.time_ns, fields)


def _build_attitude(robot: str, attitude: TimeSeries, yaw_rate: Array) -> SampleStream:
    names = ("roll_rad", "pitch_rad", "yaw_rad", "yaw_rate_radps")
    rows = np.column_stack([attitude.values, yaw_rate])
    return _build_columns(topics.ATTITUDE(robot), "Attitude", attitude.time_ns, names, rows)


def _build_columns(
    topic: str, message: str, time_ns: Times, names: Sequence[str], rows: Array
) -> SampleStream:
    return Columns(topic, message, time_ns, dict(zip(names, rows.T, strict=True)))


def _iter_motion_streams(
    robot: str, blocks: Sequence[LogBlock], attitude: TimeSeries | None
) -> Iterator[SampleStream]:
    velocity = _find_velocity(blocks)
    yaw = find_angle(blocks, "yaw") if attitude is None else attitude.select_column(2)
    if velocity is not None and yaw is not None:
        turned = yaw.interpolate(velocity.time_ns)[:, 0]
        x, y, *z = velocity.values.T
        c, s = np.cos(turned), np.sin(turned)
        rows = np.stack([c * x + s * y, c * y - s * x, *z], axis=1)
        names = ("vx_mps", "vy_mps", "vz_mps")[: rows.shape[1]]
        yield _build_columns(topics.VELOCITY(robot), "Velocity", velocity.time_ns, names, rows)
    height = find_in_metres(blocks, "z") or _derive_height(blocks, attitude)
    if height is not None:
        names = ("height_m",)
        yield _build_columns(topics.HEIGHT(robot), "Height", height.time_ns, names, height.values)


def _find_velocity(blocks: Sequence[LogBlock]) -> TimeSeries | None:
    return find_in_metres(blocks, "vx vy vz") or find_in_metres(blocks, "vx vy")


def _report_missing(robot: str, blocks: Sequence[LogBlock], where: object) -> None:
    attitude, velocity = find_attitude(blocks), _find_velocity(blocks)
    lacking = [name for name in ANGLES if attitude is None and find_angle(blocks, name) is None]
    reasons = []
    if lacking:
        reasons.append(f"no attitude: no usable stateEstimate {', '.join(lacking)}")
    if velocity is None:
        reasons.append("no velocity: no usable stateEstimate vx, vy")
    elif "yaw" in lacking:
        reasons.append("no velocity: no yaw to turn vx, vy by")
    if reasons:
        say(f"{where}: {'; '.join(reasons)}. The log is kept on {topics.LOG(robot, '*')}")


def _derive_height(blocks: Sequence[LogBlock], attitude: TimeSeries | None) -> TimeSeries | None:
    """Derive height from the downward range, corrected for the robot's tilt."""
    beam = find_series(blocks, ["range.zrange"])
    if beam is None:
        return None
    seen = (beam.values[:, 0] > 0) & (beam.values[:, 0] < MAX_ZRANGE_MM)
    time_ns, height = beam.time_ns[seen], beam.values[seen] * 1e-3
    if attitude is not None:
        height = height * np.cos(attitude.interpolate(time_ns)[:, :2]).prod(axis=1, keepdims=True)
    return TimeSeries(time_ns, height) if len(time_ns) else None


def iter_range_streams(
    robot: str, blocks: Sequence[LogBlock], names: Mapping[str, str], where: object
) -> Iterator[SampleStream]:
    """Yield streams of UWB distances. A repeated value is not a new measurement."""
    for number, time_ns, range_m in _iter_distances(blocks, where):
        peer = names.get(str(number), f"cf{number}")
        found = build_ranges(
            robot,
            peer,
            time_ns,
            np.where((range_m == 0) | np.isinf(range_m), np.nan, range_m),
            where,
        )
        if peer == robot:
            leave_out(f"ranges of {robot} to itself", where, len(found.time_ns))
        elif len(found.time_ns):
            yield found


def build_ranges(robot: str, peer: str, time_ns: Times, range_m: Array, where: object) -> Columns:
    """Build the stream of the (N,) ranges to a peer, NaN where there is none.

    Those that radios do not reach are left out and counted.
    """
    usable = (range_m > 0) & (range_m < MAX_RANGE_M)
    refused = int((~np.isnan(range_m) & ~usable).sum())
    # Fill values are some of the ranges, a wrong unit is nearly all of them.
    far = int((range_m >= MAX_RANGE_M).sum())
    unit = " (are they in cm or mm?)" if far > usable.sum() else ""
    leave_out(f"ranges to {peer} that are not over 0 and under 60 m{unit}", where, refused)
    fields = {"range_m": range_m[usable]}
    return Columns(topics.RANGE(robot, peer), "UwbRange", time_ns[usable], fields)


def _iter_distances(
    blocks: Sequence[LogBlock], where: object
) -> Iterator[tuple[int, Times, Array]]:
    """Yield the number, times and distances in metres of each peer, of its events if it has any."""
    with_events = {
        number
        for block in blocks
        if block.name == "estDistance" and {"id", "distance"} <= block.columns.keys()
        for number in np.unique(block.columns["id"]).tolist()
    }
    for block in blocks:
        for name, values in block.columns.items():
            match = DISTANCE_VARIABLE.fullmatch(name)
            if match and int(match[1]) in with_events:
                leave_out(
                    "values of distances that events have too", f"{where}: {name}", len(values)
                )
            elif match:
                fresh = find_new_values(values, polled=True)
                metres = values[fresh] * _detect_unit(values, f"{where}: {name}")
                yield int(match[1]), block.time_ns[fresh], metres
        if block.name == "estDistance" and {"id", "distance"} <= block.columns.keys():
            numbers, metres = block.columns["id"], block.columns["distance"].astype(float)
            for number in np.unique(numbers).tolist():
                mine = numbers == number
                yield int(number), block.time_ns[mine], metres[mine]


def _detect_unit(values: NDArray[Any], what: str) -> float:
    """Detect the unit by type; whole floats too large for metres are millimetres as well."""
    valid = values[np.isfinite(values) & (values > 0)].astype(float)
    if values.dtype.kind != "f":
        if valid.size and valid.max() < MAX_RANGE_M:
            say(f"{what} is read as mm, but is {valid.max():.0f} at most. Are they metres?")
        return 1e-3
    # A tool in between may have converted integers to floats.
    if valid.size and valid.min() > MAX_RANGE_M and (valid % 1 == 0).all():
        say(f"{what} has only whole numbers, {valid.min():.0f} or more: read as millimetres")
        return 1e-3
    return 1.0


def _iter_pose_streams(robot: str, blocks: Sequence[LogBlock]) -> Iterator[SampleStream]:
    estimated = _combine_pose(find_in_metres(blocks, "x y z"), find_orientation(blocks))
    true = _combine_pose(
        find_series(blocks, [f"locSrv.{n}" for n in "xyz"]), find_quaternions(blocks, "locSrv")
    )
    if estimated is not None:
        yield _build_pose_columns(topics.POSE(robot), *estimated)
    if true is not None:
        if not any(block.name == "estPose" for block in blocks):
            # A pose that is polled faster than it arrives is logged several times: keep one.
            time_ns, rows = true
            fresh = np.concatenate([[True], (np.diff(rows, axis=0) != 0).any(axis=1)])
            true = time_ns[fresh], rows[fresh]
        yield _build_pose_columns(topics.TRUE_POSE(robot), *true)
    if (placed := true or estimated) is not None:
        yield _iter_transforms(robot, *placed)


def _combine_pose(place: TimeSeries | None, turn: TimeSeries | None) -> tuple[Times, Array] | None:
    """Return (N,) times and (N, 7) x, y, z, qx, qy, qz, qw; default attitude: level, along x."""
    if place is None:
        return None
    if turn is None:
        level = np.tile([0.0, 0.0, 0.0, 1.0], (len(place.time_ns), 1))
        return place.time_ns, np.column_stack([place.values, level])
    same = np.isin(place.time_ns, turn.time_ns)
    if same.any():  # one block: matching times need no interpolation
        time_ns, first = np.unique(place.time_ns[same], return_index=True)
        at = np.searchsorted(turn.time_ns, time_ns)
        return time_ns, np.column_stack([place.values[same][first], turn.values[at]])
    nearest = np.clip(np.searchsorted(turn.time_ns, place.time_ns), 0, len(turn.time_ns) - 1)
    return place.time_ns, np.column_stack([place.values, turn.values[nearest]])


def _build_pose_columns(topic: str, time_ns: Times, rows: Array) -> SampleStream:
    pose = {
        "position": dict(zip("xyz", rows.T[:3], strict=True)),
        "orientation": dict(zip("xyzw", rows.T[3:], strict=True)),
    }
    stamp = dict(zip(("seconds", "nanos"), np.divmod(time_ns, 1_000_000_000), strict=True))
    fields = {"timestamp": stamp, "frame_id": "world", "pose": pose}
    return Columns(topic, "PoseInFrame", time_ns, fields)


def _iter_transforms(robot: str, time_ns: Times, rows: Array) -> SampleStream:
    """Yield the frames of the robot, every 50 ms."""
    first = np.unique(time_ns // TF_PERIOD_NS, return_index=True)[1]
    angles = quaternion_to_euler(rows[first, 3:])
    for moment, row, (roll, pitch, yaw) in zip(
        time_ns[first].tolist(), rows[first], angles.tolist(), strict=True
    ):
        yield flight.build_transforms(moment, {robot: RobotPose(row[:3], yaw, roll, pitch)})
