"""Selection of a Crazyflie's log variables, their distribution over blocks, and their decoding.

A block is a packet that the drone sends at a fixed period: at most 26 bytes of variables, with
the drone's time in milliseconds. All variables of a message are in one block, so that its values
are of the same instant.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from dmrl import topics
from dmrl.errors import SettingError
from dmrl.samples.sample import Sample

BLOCK_BYTES = 26
BLOCKS_MAX = 16
SIZES = {
    "uint8_t": 1,
    "int8_t": 1,
    "uint16_t": 2,
    "int16_t": 2,
    "FP16": 2,
    "uint32_t": 4,
    "int32_t": 4,
    "float": 4,
}
"""Bytes of a variable by its type, in cflib's names."""

MOTION = ("roll", "pitch", "yaw", "vx", "vy")
YAW_RATE, PITCH_RATE = "gyro.z", "gyro.y"
HEIGHT, GROUND = "stateEstimate.z", "range.zrange"
BATTERY = "pm.vbat"
SLOW_PERIOD_MS = 1000
RANGE_MAX_M = 60.0  # beyond the reach of UWB; radios report 65535 mm without an answer


@dataclass(frozen=True, slots=True)
class Variable:
    """A log variable, "group.name", and the type in which it is sent."""

    name: str
    sent_as: str


@dataclass(frozen=True, slots=True)
class Block:
    """Variables that are sent together."""

    period_ms: int
    variables: tuple[Variable, ...]

    @property
    def size(self) -> int:
        """Bytes of its variables."""
        return sum(SIZES[variable.sent_as] for variable in self.variables)


@dataclass(frozen=True, slots=True)
class Plan:
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

    blocks: tuple[Block, ...]
    peers: Mapping[str, str]
    millimetres: frozenset[str]


def number_of(robot: str) -> int | None:
    """Return the number at the end of a robot's name, its id in the firmware of others; or None."""
    found = re.search(r"\d+$", robot)
    return int(found.group()) if found else None


def plan(
    toc: Mapping[str, str], peers: Mapping[int, str], period_ms: int, *, robot: str = "the drone"
) -> Plan:
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
    motion = [Variable(f"stateEstimate.{name}", "float") for name in MOTION]
    motion.append(Variable(YAW_RATE, "float"))
    height = HEIGHT if HEIGHT in toc else GROUND
    if missing := [name for name in (*(v.name for v in motion), height) if name not in toc]:
        raise SettingError(
            f"{robot} has no log variable {', '.join(missing)}. Use a Crazyflie's firmware"
        )
    if PITCH_RATE in toc:
        # As FP16 it fits into the block. It only corrects the yaw rate for tilt.
        motion.append(Variable(PITCH_RATE, "FP16"))
    distances = {f"ranging.distance{number}": peer for number, peer in peers.items()}
    distances = {name: peer for name, peer in distances.items() if name in toc}
    rest = [Variable(name, toc[name]) for name in (height, *distances)]
    blocks = [Block(period_ms, tuple(motion)), *_packed(rest, period_ms)]
    if BATTERY in toc:
        blocks.append(Block(SLOW_PERIOD_MS, (Variable(BATTERY, toc[BATTERY]),)))
    if len(blocks) > BLOCKS_MAX:
        raise SettingError(
            f"{robot}: {len(distances)} distances need more than {BLOCKS_MAX} blocks. "
            "Pass fewer with --peer"
        )
    millimetres = frozenset(name for name in distances if toc[name] not in ("float", "FP16"))
    return Plan(tuple(blocks), distances, millimetres)


def _packed(variables: Sequence[Variable], period_ms: int) -> Iterator[Block]:
    held: list[Variable] = []
    for variable in variables:
        if Block(period_ms, (*held, variable)).size > BLOCK_BYTES:
            yield Block(period_ms, tuple(held))
            held = []
        held.append(variable)
    yield Block(period_ms, tuple(held))


@dataclass(slots=True)
class Reading:
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
    plan: Plan
    battery_v: float | None = None
    ranges_m: dict[str, float] = field(default_factory=dict)
    _known: dict[str, float] = field(default_factory=dict)

    def samples(self, time_ns: int, values: Mapping[str, float]) -> Iterator[Sample]:
        """Yield the samples of a packet.

        Parameters
        ----------
        time_ns
            Time at which the drone measured it.
        values
            Values by variable.
        """
        if YAW_RATE in values:
            yield from self._motion(time_ns, values)
        for name, factor in ((HEIGHT, 1.0), (GROUND, 1e-3)):
            if name in values and math.isfinite(values[name]):
                height = {"height_m": values[name] * factor}
                yield Sample(time_ns, topics.height(self.robot), "Height", height)
        for name in values.keys() & self.plan.peers.keys():
            yield from self._distance(time_ns, name, values[name])
        self.battery_v = values.get(BATTERY, self.battery_v)

    def _motion(self, time_ns: int, values: Mapping[str, float]) -> Iterator[Sample]:
        roll, pitch, yaw = (math.radians(values[f"stateEstimate.{n}"]) for n in MOTION[:3])
        vx, vy = (values[f"stateEstimate.{name}"] for name in MOTION[3:])
        about_y, about_z = (math.radians(values.get(n, 0.0)) for n in (PITCH_RATE, YAW_RATE))
        if not all(map(math.isfinite, (roll, pitch, yaw, vx, vy, about_y, about_z))):
            return
        yaw_rate = (about_y * math.sin(roll) + about_z * math.cos(roll)) / math.cos(pitch)
        attitude = {"roll_rad": roll, "pitch_rad": -pitch, "yaw_rad": yaw}
        attitude["yaw_rate_radps"] = yaw_rate
        yield Sample(time_ns, topics.attitude(self.robot), "Attitude", attitude)
        c, s = math.cos(yaw), math.sin(yaw)
        velocity = {"vx_mps": c * vx + s * vy, "vy_mps": c * vy - s * vx}
        yield Sample(time_ns, topics.velocity(self.robot), "Velocity", velocity)

    def _distance(self, time_ns: int, name: str, value: float) -> Iterator[Sample]:
        # The variable keeps its value until the next ranging: only a change is a measurement,
        # and the age of the first one is unknown.
        known = self._known.get(name)
        self._known[name] = value
        range_m = value / 1000 if name in self.plan.millimetres else value
        if known is None or value == known or not 0 < range_m < RANGE_MAX_M:
            return
        peer = self.plan.peers[name]
        self.ranges_m[peer] = range_m
        yield Sample(time_ns, topics.uwb_range(self.robot, peer), "UwbRange", {"range_m": range_m})
