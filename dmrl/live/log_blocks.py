"""Selection of a Crazyflie's log variables, their distribution over blocks, and their decoding.

A block is a packet that the drone sends at a fixed period: at most 26 bytes of variables, with
the drone's time in milliseconds. All variables of a message are in one block, so that its values
are of the same instant.
"""

import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from dmrl import topics
from dmrl.errors import SettingError
from dmrl.samples.sample import Sample

BLOCK_BYTES = 26
MAX_BLOCKS = 16
LOG_TYPES = {
    "uint8_t": (1, "B"),
    "uint16_t": (2, "H"),
    "uint32_t": (3, "I"),
    "int8_t": (4, "b"),
    "int16_t": (5, "h"),
    "int32_t": (6, "i"),
    "float": (7, "f"),
    "FP16": (8, "e"),
}
"""Number and `struct` format of each type of variable, by cflib's name."""
VARIABLE_BYTES = {name: struct.calcsize(f"<{code}") for name, (_, code) in LOG_TYPES.items()}

MOTION_VARIABLES = ("roll", "pitch", "yaw", "vx", "vy")
YAW_RATE_VARIABLE, PITCH_RATE_VARIABLE = "gyro.z", "gyro.y"
HEIGHT_VARIABLE, GROUND_VARIABLE = "stateEstimate.z", "range.zrange"
BATTERY_VARIABLE, DISTANCE_VARIABLE = "pm.vbat", "ranging.distance"
SLOW_PERIOD_MS = 1000
MAX_RANGE_M = 60.0  # beyond the reach of UWB; radios report 65535 mm without an answer


@dataclass(frozen=True, slots=True)
class RequestedVariable:
    """A log variable, "group.name", and the type in which it is sent."""

    name: str
    sent_as: str


@dataclass(frozen=True, slots=True)
class RequestedBlock:
    """Variables that are sent together."""

    period_ms: int
    variables: tuple[RequestedVariable, ...]

    @property
    def size(self) -> int:
        """Bytes of its variables."""
        return sum(VARIABLE_BYTES[variable.sent_as] for variable in self.variables)


@dataclass(frozen=True, slots=True)
class LogPlan:
    """Log blocks requested from one drone.

    Parameters
    ----------
    blocks
        Blocks in the order of creation; the first contains the motion.
    peers
        Peer by the name of the variable with the distance to it.
    millimetres
        Distance variables in millimetres; others are in metres.
    """

    blocks: tuple[RequestedBlock, ...]
    peers: Mapping[str, str]
    millimetres: frozenset[str]


def parse_robot_number(robot: str) -> int | None:
    """Return the number at the end of a robot's name, its id in the firmware of others; or None."""
    found = re.search(r"\d+$", robot)
    return int(found.group()) if found else None


def plan_blocks(
    toc: Mapping[str, str], peers: Mapping[int, str], period_ms: int, *, robot: str = "the drone"
) -> LogPlan:
    """Plan blocks with all variables that are needed and that the drone has.

    Parameters
    ----------
    toc
        Type of each log variable of the drone by "group.name".
    peers
        Robot to which ``ranging.distance<number>`` is the distance, by number.
    period_ms
        Period of the blocks with motion, height and distances.
    robot
        Its name in errors.

    Raises
    ------
    SettingError
        If it lacks a required variable, or needs too many blocks.
    """
    motion = [RequestedVariable(f"stateEstimate.{name}", "float") for name in MOTION_VARIABLES]
    motion.append(RequestedVariable(YAW_RATE_VARIABLE, "float"))
    height = HEIGHT_VARIABLE if HEIGHT_VARIABLE in toc else GROUND_VARIABLE
    if missing := [name for name in (*(v.name for v in motion), height) if name not in toc]:
        raise SettingError(f"{robot} has no log variable {', '.join(missing)}. Update its firmware")
    if PITCH_RATE_VARIABLE in toc:
        # As FP16 it fits into the block. It only corrects the yaw rate for tilt.
        motion.append(RequestedVariable(PITCH_RATE_VARIABLE, "FP16"))
    distances = {f"{DISTANCE_VARIABLE}{number}": peer for number, peer in peers.items()}
    distances = {name: peer for name, peer in distances.items() if name in toc}
    rest = [RequestedVariable(name, toc[name]) for name in (height, *distances)]
    blocks = [RequestedBlock(period_ms, tuple(motion)), *_pack_blocks(rest, period_ms)]
    if BATTERY_VARIABLE in toc:
        battery = RequestedVariable(BATTERY_VARIABLE, toc[BATTERY_VARIABLE])
        blocks.append(RequestedBlock(SLOW_PERIOD_MS, (battery,)))
    if len(blocks) > MAX_BLOCKS:
        raise SettingError(
            f"{robot}: {len(distances)} distances need more than {MAX_BLOCKS} blocks. "
            "Pass fewer with --peer"
        )
    millimetres = frozenset(name for name in distances if toc[name] not in ("float", "FP16"))
    return LogPlan(tuple(blocks), distances, millimetres)


def _pack_blocks(
    variables: Sequence[RequestedVariable], period_ms: int
) -> Iterator[RequestedBlock]:
    held: list[RequestedVariable] = []
    for variable in variables:
        if RequestedBlock(period_ms, (*held, variable)).size > BLOCK_BYTES:
            yield RequestedBlock(period_ms, tuple(held))
            held = []
        held.append(variable)
    yield RequestedBlock(period_ms, tuple(held))


@dataclass(slots=True)
class LogDecoder:
    """Decoder of a drone's block values to samples, one packet after the other.

    The log's pitch is positive nose up, and its velocity is along the axes of the take-off. In the
    samples, pitch is positive nose down, and velocity turns with the robot.

    Parameters
    ----------
    robot
        Its name.
    plan
        The requested blocks.
    """

    robot: str
    plan: LogPlan
    battery_v: float | None = None
    ranges_m: dict[str, float] = field(default_factory=dict)
    _known: dict[str, float] = field(default_factory=dict)

    def iter_samples(self, time_ns: int, values: Mapping[str, float]) -> Iterator[Sample]:
        """Yield the samples of a packet.

        Parameters
        ----------
        time_ns
            Time at which the drone measured it.
        values
            Values by variable.
        """
        if YAW_RATE_VARIABLE in values:
            yield from self._iter_motion(time_ns, values)
        for name, factor in ((HEIGHT_VARIABLE, 1.0), (GROUND_VARIABLE, 1e-3)):
            if name in values and math.isfinite(values[name]):
                height = {"height_m": values[name] * factor}
                yield Sample(time_ns, topics.HEIGHT(self.robot), "Height", height)
        for name in values.keys() & self.plan.peers.keys():
            yield from self._iter_range(time_ns, name, values[name])
        self.battery_v = values.get(BATTERY_VARIABLE, self.battery_v)

    def _iter_motion(self, time_ns: int, values: Mapping[str, float]) -> Iterator[Sample]:
        roll, pitch, yaw = (
            math.radians(values[f"stateEstimate.{n}"]) for n in MOTION_VARIABLES[:3]
        )
        vx, vy = (values[f"stateEstimate.{name}"] for name in MOTION_VARIABLES[3:])
        about_y, about_z = (
            math.radians(values.get(n, 0.0)) for n in (PITCH_RATE_VARIABLE, YAW_RATE_VARIABLE)
        )
        if not all(map(math.isfinite, (roll, pitch, yaw, vx, vy, about_y, about_z))):
            return
        yaw_rate = (about_y * math.sin(roll) + about_z * math.cos(roll)) / math.cos(pitch)
        attitude = {"roll_rad": roll, "pitch_rad": -pitch, "yaw_rad": yaw}
        attitude["yaw_rate_radps"] = yaw_rate
        yield Sample(time_ns, topics.ATTITUDE(self.robot), "Attitude", attitude)
        c, s = math.cos(yaw), math.sin(yaw)
        velocity = {"vx_mps": c * vx + s * vy, "vy_mps": c * vy - s * vx}
        yield Sample(time_ns, topics.VELOCITY(self.robot), "Velocity", velocity)

    def _iter_range(self, time_ns: int, name: str, value: float) -> Iterator[Sample]:
        # The variable keeps its value until the next ranging: only a change is a measurement,
        # and the age of the first one is unknown.
        known = self._known.get(name)
        self._known[name] = value
        range_m = value / 1000 if name in self.plan.millimetres else value
        if known is None or value == known or not 0 < range_m < MAX_RANGE_M:
            return
        peer = self.plan.peers[name]
        self.ranges_m[peer] = range_m
        yield Sample(time_ns, topics.RANGE(self.robot, peer), "UwbRange", {"range_m": range_m})
