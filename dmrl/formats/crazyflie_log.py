"""Log variables of the Crazyflie, by their names, in dmrl's units and signs.

Every block is kept as it was logged, on ``/<robot>/log/<block>``. What is known of it comes
besides, on dmrl's own topics:

* attitude, from ``stateEstimate.q*``, ``stateEstimate`` or ``stabilizer`` ``.roll .pitch
  .yaw`` (degrees, pitch positive nose up: turned round here), or ``stateEstimateZ.quat``;
* its turning rate about the vertical, from ``gyro.*`` (degrees a second, body axes);
* velocity, from ``stateEstimate.v*``: in the frame of take-off, turned by -yaw;
* height, from ``stateEstimate.z``, else ``range.zrange`` (millimetres along the body's z);
* ranges, from ``ranging.distanceN`` (metres as a float, millimetres as an integer) and the
  event ``estDistance``;
* pose and true pose, from ``stateEstimate`` and ``locSrv`` (motion capture).
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dmrl import topics
from dmrl.formats.log_block import (
    Block,
    Series,
    euler_zyx,
    quaternion_zyx,
    series,
    unpacked_quaternion,
)
from dmrl.geometry.frames import Array
from dmrl.messages import LogType
from dmrl.samples import flight
from dmrl.samples.flight import Placed, Times
from dmrl.samples.sample import Sample
from dmrl.terminal.progress import say

RANGE_MAX_M = 60.0
ZRANGE_MAX_MM = 8000.0  # the sensor says 32766 and the like where it sees no floor
TF_PERIOD_NS = 50_000_000
DISTANCE = re.compile(r"ranging\.distance(\d+)")

Stream = Iterator[Sample]


def streams(
    robot: str, blocks: Sequence[Block], names: Mapping[str, str], where: object = "the log"
) -> list[Stream]:
    """Samples of a robot's log: each stream in time order.

    Parameters
    ----------
    robot
        Its name.
    blocks
        What it logged.
    names
        Names of the robots that it ranges to, by their number; others are ``cf<number>``.
    where
        The source, for warnings.
    """
    blocks = [_ordered(block) for block in blocks]
    found = [as_logged(robot, block) for block in blocks]
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
    """Every variable of a block, exactly as it was logged."""
    codes = {name: values.dtype.char.replace("l", "i") for name, values in block.columns.items()}
    kind = LogType(block.name, tuple(codes.items()))
    topic = topics.log(robot, re.sub(r"[^A-Za-z0-9_-]", "_", block.name))
    rows: Iterable[tuple[Any, ...]] = zip(
        *(values.tolist() for values in block.columns.values()), strict=True
    )
    if not block.columns:
        rows = ((),) * len(block.time_ns)
    for moment, row in zip(block.time_ns.tolist(), rows, strict=True):
        yield Sample(moment, topic, kind, dict(zip(kind.fields, row, strict=True)))


def attitude_of(blocks: Sequence[Block]) -> Series | None:
    """Roll, pitch, yaw of Rz Ry Rx, radians, (N, 3), yaw unwrapped; None: not logged."""
    turned = _quaternions(blocks)
    if turned is not None:
        angles = euler_zyx(turned.values)
        return Series(turned.time_ns, _unwrapped(angles))
    for group in ("stateEstimate", "stabilizer"):
        logged = series(blocks, [f"{group}.{name}" for name in ("roll", "pitch", "yaw")])
        if logged is not None:
            angles = np.radians(logged.values) * (1.0, -1.0, 1.0)
            return Series(logged.time_ns, _unwrapped(angles))
    return None


def _unwrapped(angles: Array) -> Array:
    return np.column_stack([angles[:, :2], np.unwrap(angles[:, 2])])


def _quaternions(blocks: Sequence[Block], group: str = "stateEstimate") -> Series | None:
    """(N, 4) unit quaternions x, y, z, w; rows before the estimator has started are left out."""
    logged = series(blocks, [f"{group}.{name}" for name in ("qx", "qy", "qz", "qw")])
    packed = series(blocks, ["stateEstimateZ.quat"]) if group == "stateEstimate" else None
    if logged is None and packed is not None:
        logged = Series(packed.time_ns, unpacked_quaternion(packed.values[:, 0].astype(np.int64)))
    if logged is None:
        return None
    norm = np.linalg.norm(logged.values, axis=1)
    good = np.abs(norm - 1) < 0.1
    if not good.any():
        return None
    return Series(logged.time_ns[good], logged.values[good] / norm[good, None])


def yaw_rate_of(blocks: Sequence[Block], attitude: Series) -> Array:
    """(N,) turning rate about the vertical at the times of the attitude, radians a second.

    From the gyroscope: (q sin(roll) + r cos(roll)) / cos(pitch), or r alone where q was not
    logged; without a gyroscope, the slope of the yaw.
    """
    roll, pitch, yaw = attitude.values.T
    both = series(blocks, ["gyro.y", "gyro.z"])
    if both is not None:
        q, r = np.radians(both.at(attitude.time_ns)).T
        return np.asarray((q * np.sin(roll) + r * np.cos(roll)) / np.cos(pitch))
    for name, unit in (("gyro.z", np.pi / 180), ("stateEstimateZ.rateYaw", 1e-3)):
        alone = series(blocks, [name])
        if alone is not None:
            return np.asarray(alone.at(attitude.time_ns)[:, 0] * unit)
    time_s = (attitude.time_ns - attitude.time_ns[0]) * 1e-9
    usable = len(yaw) > 1 and (np.diff(time_s) > 0).all()
    return np.asarray(np.gradient(yaw, time_s) if usable else 0 * yaw)


def _attitude(robot: str, attitude: Series, yaw_rate: Array) -> Stream:
    names = ("roll_rad", "pitch_rad", "yaw_rad", "yaw_rate_radps")
    rows = np.column_stack([attitude.values, yaw_rate])
    return _samples(topics.attitude(robot), "Attitude", attitude.time_ns, names, rows)


def _samples(topic: str, message: str, time_ns: Times, names: Sequence[str], rows: Array) -> Stream:
    for moment, row in zip(time_ns.tolist(), rows.tolist(), strict=True):
        yield Sample(moment, topic, message, dict(zip(names, row, strict=True)))


def _scaled(blocks: Sequence[Block], names: str) -> Series | None:
    """State in metres: from stateEstimate, else from stateEstimateZ, in millimetres."""
    plain = series(blocks, [f"stateEstimate.{name}" for name in names.split()])
    if plain is not None:
        return plain
    packed = series(blocks, [f"stateEstimateZ.{name}" for name in names.split()])
    return None if packed is None else Series(packed.time_ns, packed.values * 1e-3)


def _motion(
    robot: str, blocks: Sequence[Block], attitude: Series | None, where: object
) -> Iterator[Stream]:
    velocity = _scaled(blocks, "vx vy vz") or _scaled(blocks, "vx vy")
    if velocity is not None and attitude is None:
        say(f"{where}: velocity, but no yaw to turn it by; on {topics.log(robot, '*')} only")
    elif velocity is not None and attitude is not None:
        yaw = attitude.at(velocity.time_ns)[:, 2]
        x, y, *z = velocity.values.T
        c, s = np.cos(yaw), np.sin(yaw)
        rows = np.stack([c * x + s * y, c * y - s * x, *z], axis=1)
        names = ("vx_mps", "vy_mps", "vz_mps")[: rows.shape[1]]
        yield _samples(topics.velocity(robot), "Velocity", velocity.time_ns, names, rows)
    height = _scaled(blocks, "z") or _flown_over(blocks, attitude)
    if height is not None:
        names = ("height_m",)
        yield _samples(topics.height(robot), "Height", height.time_ns, names, height.values)


def _flown_over(blocks: Sequence[Block], attitude: Series | None) -> Series | None:
    """Height from the downward range, which leans with the robot."""
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
    """UWB distances. A logged value that did not change is the same measurement still."""
    for number, time_ns, range_m in _distances(blocks):
        peer = names.get(str(number), f"cf{number}")
        usable = np.isfinite(range_m) & (range_m > 0) & (range_m < RANGE_MAX_M)
        if refused := int((np.isfinite(range_m) & (range_m != 0) & ~usable).sum()):
            say(f"{where}: {refused} ranges to {peer} left out: not over 0 and under 60 m")
        if peer == robot or not usable.any():
            continue
        yield flight.ranges(robot, peer, time_ns[usable], range_m[usable])


def _distances(blocks: Sequence[Block]) -> Iterator[tuple[int, Times, Array]]:
    """(number of the peer, times, metres) of each peer."""
    for block in blocks:
        for name, values in block.columns.items():
            match = DISTANCE.fullmatch(name)
            if match:
                fresh = np.concatenate([[True], values[1:] != values[:-1]])
                unit = 1.0 if values.dtype.kind == "f" else 1e-3
                yield int(match[1]), block.time_ns[fresh], values[fresh].astype(float) * unit
        if block.name == "estDistance" and {"id", "distance"} <= block.columns.keys():
            numbers, metres = block.columns["id"], block.columns["distance"].astype(float)
            for number in np.unique(numbers).tolist():
                mine = numbers == number
                yield int(number), block.time_ns[mine], metres[mine]


def _poses(robot: str, blocks: Sequence[Block]) -> Iterator[Stream]:
    estimated = _pose(_scaled(blocks, "x y z"), _quaternions(blocks) or _from_angles(blocks))
    true = _pose(series(blocks, [f"locSrv.{n}" for n in "xyz"]), _quaternions(blocks, "locSrv"))
    if estimated is not None:
        yield _pose_samples(topics.pose(robot), *estimated)
    if true is not None:
        if not any(block.name == "estPose" for block in blocks):
            # Polled faster than it comes, a pose stands several times: once is enough.
            time_ns, rows = true
            fresh = np.concatenate([[True], (np.diff(rows, axis=0) != 0).any(axis=1)])
            true = time_ns[fresh], rows[fresh]
        yield _pose_samples(topics.true_pose(robot), *true)
    if (placed := true or estimated) is not None:
        yield _transforms(robot, *placed)


def _from_angles(blocks: Sequence[Block]) -> Series | None:
    attitude = attitude_of(blocks)
    if attitude is None:
        return None
    return Series(attitude.time_ns, quaternion_zyx(attitude.values))


def _pose(place: Series | None, turn: Series | None) -> tuple[Times, Array] | None:
    """(N,) times and (N, 7) x, y, z, qx, qy, qz, qw; no turn: level, looking along x."""
    if place is None:
        return None
    if turn is None:
        level = np.tile([0.0, 0.0, 0.0, 1.0], (len(place.time_ns), 1))
        return place.time_ns, np.column_stack([place.values, level])
    same = np.isin(place.time_ns, turn.time_ns)
    if same.any():  # one block: no need to interpolate
        time_ns, first = np.unique(place.time_ns[same], return_index=True)
        at = np.searchsorted(turn.time_ns, time_ns)
        return time_ns, np.column_stack([place.values[same][first], turn.values[at]])
    nearest = np.clip(np.searchsorted(turn.time_ns, place.time_ns), 0, len(turn.time_ns) - 1)
    return place.time_ns, np.column_stack([place.values, turn.values[nearest]])


def _pose_samples(topic: str, time_ns: Times, rows: Array) -> Stream:
    for moment, row in zip(time_ns.tolist(), rows.tolist(), strict=True):
        seconds, nanos = divmod(moment, 1_000_000_000)
        pose = {
            "position": dict(zip("xyz", row[:3], strict=True)),
            "orientation": dict(zip("xyzw", row[3:], strict=True)),
        }
        stamp = {"seconds": seconds, "nanos": nanos}
        fields = {"timestamp": stamp, "frame_id": "world", "pose": pose}
        yield Sample(moment, topic, "PoseInFrame", fields)


def _transforms(robot: str, time_ns: Times, rows: Array) -> Stream:
    """Frames of the robot, every 50 ms."""
    first = np.unique(time_ns // TF_PERIOD_NS, return_index=True)[1]
    angles = euler_zyx(rows[first, 3:])
    for moment, row, (roll, pitch, yaw) in zip(
        time_ns[first].tolist(), rows[first], angles.tolist(), strict=True
    ):
        yield flight.transforms(moment, {robot: Placed(row[:3], yaw, roll, pitch)})
