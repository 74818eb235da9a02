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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.formats.crazyflie.log_block import Block, Series, series
from dmrl.formats.crazyflie.state import (
    ANGLES,
    angle_of,
    attitude_of,
    quaternions_of,
    scaled,
    turn_of,
    yaw_rate_of,
)
from dmrl.geometry.frames import Array
from dmrl.geometry.rotations import euler_zyx
from dmrl.messages import LogType
from dmrl.samples import flight
from dmrl.samples.flight import Placed, Times
from dmrl.samples.sample import Columns, Sample
from dmrl.terminal.progress import say

RANGE_MAX_M = 60.0
ZRANGE_MAX_MM = 8000.0  # the sensor reports values such as 32766 where it detects no floor
TF_PERIOD_NS = 50_000_000
DISTANCE = re.compile(r"ranging\.distance(\d+)")

Stream = Iterable[Sample]


def streams(
    robot: str, blocks: Sequence[Block], names: Mapping[str, str], where: object = "the log"
) -> list[Stream]:
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
    """
    blocks = [_ordered(block) for block in blocks]
    logged = [as_logged(robot, block) for block in blocks]
    return logged + derived(robot, blocks, names, where)


def derived(
    robot: str, blocks: Sequence[Block], names: Mapping[str, str], where: object
) -> list[Stream]:
    """Derive dmrl's own topics from blocks in time order; see the module."""
    found: list[Stream] = []
    attitude = attitude_of(blocks)
    if attitude is not None:
        found.append(_attitude(robot, attitude, yaw_rate_of(blocks, attitude)))
    found += _motion(robot, blocks, attitude, where)
    found += ranges_of(robot, blocks, names, where)
    found += _poses(robot, blocks)
    return found


def _ordered(block: Block) -> Block:
    if (np.diff(block.time_ns) >= 0).all():
        return block
    order = np.argsort(block.time_ns, kind="stable")
    return Block(
        block.name, block.time_ns[order], {name: v[order] for name, v in block.columns.items()}
    )


def as_logged(robot: str, block: Block) -> Stream:
    """Build the stream of a block's variables, exactly as they were logged."""
    codes = {name: values.dtype.char.replace("l", "i") for name, values in block.columns.items()}
    kind = LogType(block.name, tuple(codes.items()))
    topic = topics.log(robot, re.sub(r"[^A-Za-z0-9_-]", "_", block.name))
    fields = dict(zip(kind.fields, block.columns.values(), strict=True))
    return Columns(topic, kind, block.time_ns, fields)


def _attitude(robot: str, attitude: Series, yaw_rate: Array) -> Stream:
    names = ("roll_rad", "pitch_rad", "yaw_rad", "yaw_rate_radps")
    rows = np.column_stack([attitude.values, yaw_rate])
    return _samples(topics.attitude(robot), "Attitude", attitude.time_ns, names, rows)


def _samples(topic: str, message: str, time_ns: Times, names: Sequence[str], rows: Array) -> Stream:
    return Columns(topic, message, time_ns, dict(zip(names, rows.T, strict=True)))


def _motion(
    robot: str, blocks: Sequence[Block], attitude: Series | None, where: object
) -> Iterator[Stream]:
    velocity = scaled(blocks, "vx vy vz") or scaled(blocks, "vx vy")
    yaw = angle_of(blocks, "yaw") if attitude is None else attitude.part(2)
    _say_what_lacks(robot, blocks, attitude, velocity, where)
    if velocity is not None and yaw is not None:
        turned = yaw.at(velocity.time_ns)[:, 0]
        x, y, *z = velocity.values.T
        c, s = np.cos(turned), np.sin(turned)
        rows = np.stack([c * x + s * y, c * y - s * x, *z], axis=1)
        names = ("vx_mps", "vy_mps", "vz_mps")[: rows.shape[1]]
        yield _samples(topics.velocity(robot), "Velocity", velocity.time_ns, names, rows)
    height = scaled(blocks, "z") or _flown_over(blocks, attitude)
    if height is not None:
        names = ("height_m",)
        yield _samples(topics.height(robot), "Height", height.time_ns, names, height.values)


def _say_what_lacks(
    robot: str,
    blocks: Sequence[Block],
    attitude: Series | None,
    velocity: Series | None,
    where: object,
) -> None:
    lacking = [name for name in ANGLES if attitude is None and angle_of(blocks, name) is None]
    reasons = []
    if lacking:
        reasons.append(f"no attitude: no usable stateEstimate {', '.join(lacking)}")
    if velocity is None:
        reasons.append("no velocity: no usable stateEstimate vx, vy")
    elif "yaw" in lacking:
        reasons.append("no velocity: no yaw to turn vx, vy by")
    if reasons:
        say(f"{where}: {'; '.join(reasons)}. The log is kept on {topics.log(robot, '*')}")


def _flown_over(blocks: Sequence[Block], attitude: Series | None) -> Series | None:
    """Derive height from the downward range, corrected for the robot's tilt."""
    beam = series(blocks, ["range.zrange"])
    if beam is None:
        return None
    seen = (beam.values[:, 0] > 0) & (beam.values[:, 0] < ZRANGE_MAX_MM)
    time_ns, height = beam.time_ns[seen], beam.values[seen] * 1e-3
    if attitude is not None:
        height = height * np.cos(attitude.at(time_ns)[:, :2]).prod(axis=1, keepdims=True)
    return Series(time_ns, height) if len(time_ns) else None


def ranges_of(
    robot: str, blocks: Sequence[Block], names: Mapping[str, str], where: object
) -> Iterator[Stream]:
    """Yield streams of UWB distances. A repeated value is not a new measurement."""
    for number, time_ns, range_m in _distances(blocks, where):
        peer = names.get(str(number), f"cf{number}")
        usable = np.isfinite(range_m) & (range_m > 0) & (range_m < RANGE_MAX_M)
        if refused := int((np.isfinite(range_m) & (range_m != 0) & ~usable).sum()):
            say(f"{where}: {refused} ranges to {peer} left out: not over 0 and under 60 m")
        if peer == robot or not usable.any():
            continue
        topic = topics.uwb_range(robot, peer)
        yield Columns(topic, "UwbRange", time_ns[usable], {"range_m": range_m[usable]})


def _distances(blocks: Sequence[Block], where: object) -> Iterator[tuple[int, Times, Array]]:
    """Yield the number, times and distances in metres of each peer."""
    for block in blocks:
        for name, values in block.columns.items():
            match = DISTANCE.fullmatch(name)
            if match:
                fresh = np.concatenate([[True], values[1:] != values[:-1]])
                metres = values[fresh] * _metres_per_unit(values, f"{where}: {name}")
                yield int(match[1]), block.time_ns[fresh], metres
        if block.name == "estDistance" and {"id", "distance"} <= block.columns.keys():
            numbers, metres = block.columns["id"], block.columns["distance"].astype(float)
            for number in np.unique(numbers).tolist():
                mine = numbers == number
                yield int(number), block.time_ns[mine], metres[mine]


def _metres_per_unit(values: NDArray[Any], what: str) -> float:
    """Detect the unit by type; whole floats too large for metres are millimetres as well."""
    valid = values[np.isfinite(values) & (values > 0)].astype(float)
    if values.dtype.kind != "f":
        if valid.size and valid.max() < RANGE_MAX_M:
            say(f"{what} is read as mm, but is {valid.max():.0f} at most. Are they metres?")
        return 1e-3
    # A tool in between may have converted integers to floats.
    if valid.size and valid.min() > RANGE_MAX_M and (valid % 1 == 0).all():
        say(f"{what} has only whole numbers, {valid.min():.0f} or more: read as millimetres")
        return 1e-3
    return 1.0


def _poses(robot: str, blocks: Sequence[Block]) -> Iterator[Stream]:
    estimated = _pose(scaled(blocks, "x y z"), turn_of(blocks))
    true = _pose(series(blocks, [f"locSrv.{n}" for n in "xyz"]), quaternions_of(blocks, "locSrv"))
    if estimated is not None:
        yield _pose_samples(topics.pose(robot), *estimated)
    if true is not None:
        if not any(block.name == "estPose" for block in blocks):
            # A pose that is polled faster than it arrives is logged several times: keep one.
            time_ns, rows = true
            fresh = np.concatenate([[True], (np.diff(rows, axis=0) != 0).any(axis=1)])
            true = time_ns[fresh], rows[fresh]
        yield _pose_samples(topics.true_pose(robot), *true)
    if (placed := true or estimated) is not None:
        yield _transforms(robot, *placed)


def _pose(place: Series | None, turn: Series | None) -> tuple[Times, Array] | None:
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


def _pose_samples(topic: str, time_ns: Times, rows: Array) -> Stream:
    pose = {
        "position": dict(zip("xyz", rows.T[:3], strict=True)),
        "orientation": dict(zip("xyzw", rows.T[3:], strict=True)),
    }
    seconds, nanos = np.divmod(time_ns, 1_000_000_000)
    stamp = {"seconds": seconds, "nanos": nanos}
    fields = {"timestamp": stamp, "frame_id": "world", "pose": pose}
    return Columns(topic, "PoseInFrame", time_ns, fields)


def _transforms(robot: str, time_ns: Times, rows: Array) -> Stream:
    """Yield the frames of the robot, every 50 ms."""
    first = np.unique(time_ns // TF_PERIOD_NS, return_index=True)[1]
    angles = euler_zyx(rows[first, 3:])
    for moment, row, (roll, pitch, yaw) in zip(
        time_ns[first].tolist(), rows[first], angles.tolist(), strict=True
    ):
        yield flight.transforms(moment, {robot: Placed(row[:3], yaw, roll, pitch)})
