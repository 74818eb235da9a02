"""Which log variables of a Crazyflie are asked for, in which blocks, and what they mean.

A block is a packet that the drone sends at an even pace: 26 bytes of variables at most, with
the drone's time in milliseconds. What belongs to one message goes into one block, so that its
values are of one instant.
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
"""Bytes of a variable by its type, as cflib names types."""

MOTION = ("roll", "pitch", "yaw", "vx", "vy")
YAW_RATE, PITCH_RATE = "gyro.z", "gyro.y"
HEIGHT, GROUND = "stateEstimate.z", "range.zrange"
BATTERY = "pm.vbat"
SLOW_PERIOD_MS = 1000
RANGE_MAX_M = 60.0  # beyond the reach of UWB; radios that found nothing say 65535 mm


@dataclass(frozen=True, slots=True)
class Variable:
    """A log variable, "group.name", and the type it is sent as."""

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
    """What is asked of one drone.

    Parameters
    ----------
    blocks
        In the order of creation; the first holds the motion.
    peers
        Peer by the name of the variable with the distance to it.
    millimetres
        Distances that come in millimetres; metres otherwise.
    """

    blocks: tuple[Block, ...]
    peers: Mapping[str, str]
    millimetres: frozenset[str]


def number_of(robot: str) -> int | None:
    """The number at the end of a robot's name, by which others' firmware counts it."""
    found = re.search(r"\d+$", robot)
    return int(found.group()) if found else None


def plan(
    toc: Mapping[str, str], peers: Mapping[int, str], period_ms: int, *, robot: str = "the drone"
) -> Plan:
    """Blocks that hold all that is wanted and the drone has.

    Parameters
    ----------
    toc
        Type of each log variable of the drone by "group.name".
    peers
        Name of the robot that ``ranging.distance<number>`` is the distance to, by number.
    period_ms
        Of the blocks with motion, height and distances.
    robot
        Its name in errors.

    Raises
    ------
    SettingError
        If it lacks what every flight needs, or has more than can be sent.
    """
    motion = [Variable(f"stateEstimate.{name}", "float") for name in MOTION]
    motion.append(Variable(YAW_RATE, "float"))
    height = HEIGHT if HEIGHT in toc else GROUND
    if missing := [name for name in (*(v.name for v in motion), height) if name not in toc]:
        raise SettingError(
            f"{robot} has no log variable {', '.join(missing)}. Is its firmware a Crazyflie's?"
        )
    if PITCH_RATE in toc:
        # With half the bits it fits; it only corrects the turning rate for tilt.
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
            "Name fewer with --peer"
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
    """Values of a drone's blocks, one after the other, as samples.

    The log's pitch is positive nose up and its velocity is along the axes of the take-off:
    here pitch is positive nose down, and velocity turns with the robot.

    Parameters
    ----------
    robot
        Its name.
    plan
        What was asked.
    """

    robot: str
    plan: Plan
    battery_v: float | None = None
    ranges_m: dict[str, float] = field(default_factory=dict)
    _known: dict[str, float] = field(default_factory=dict)

    def samples(self, time_ns: int, values: Mapping[str, float]) -> Iterator[Sample]:
        """What a packet says.

        Parameters
        ----------
        time_ns
            When the drone took it.
        values
            By variable.
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
        # and how old the first one is nobody knows.
        known = self._known.get(name)
        self._known[name] = value
        range_m = value / 1000 if name in self.plan.millimetres else value
        if known is None or value == known or not 0 < range_m < RANGE_MAX_M:
            return
        peer = self.plan.peers[name]
        self.ranges_m[peer] = range_m
        yield Sample(time_ns, topics.uwb_range(self.robot, peer), "UwbRange", {"range_m": range_m})
