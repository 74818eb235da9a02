"""Motion of robots: commands, lag in velocity and yaw rate, and tilt from acceleration.

The plane is complex in this file: x is the real part, y the imaginary part. A rotation by
``yaw`` is a product with exp(1j yaw).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dmrl.flight.flight_arrays import RATE_HZ, Signal, Truth, iter_numbers, scan_values
from dmrl.geometry.frames import Array

Plane = NDArray[np.complex128]
Trajectory = Literal[
    "in_view",
    "random",
    "room",
    "lawn_mower",
    "hover",
    "parallel",
    "observer_static",
    "peer_static",
    "no_yaw",
    "both_static",
    "figure_of_eight",
]

VELOCITY_LAG_S = 0.25
YAW_RATE_LAG_S = 0.15
GRAVITY_MPS2 = 9.81
SPEED_MAX_MPS = 1.2
VIEW_DISTANCE_M = (0.5, 2.0)
VIEW_BEARING_RAD = 0.6
VIEW_REDRAW_S = 2.5
FOLLOW_GAIN_PER_S = 2.0
ROOM_M, ROOM_REDRAW_S = 3.6, 3.0
HOVER_SPEED_MPS = 0.03
ROW_M, ROW_GAP_M, ROWS = 2.0, 0.4, 5
EIGHT_HALF_AXES_M = 1.6, 1.2
EIGHT_ROUND_S = 18.0, 30.0
EIGHT_SPEED_MAX_MPS = 0.6
EIGHT_YAW_RAD, EIGHT_YAW_S = 0.6, 9.0
"""Amplitude and period of the yaw of a robot that flies a figure of eight."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of one robot over the floor, (N,) each, 100 Hz.

    Parameters
    ----------
    position, velocity
        World frame, metres and metres per second, complex.
    yaw
        Radians, not wrapped.
    yaw_rate
        Radians per second.
    """

    position: Plane
    velocity: Plane
    yaw: Array
    yaw_rate: Array


@dataclass(frozen=True, slots=True)
class Start:
    """State of a robot at the start of the flight.

    Parameters
    ----------
    samples
        Length of the flight at 100 Hz.
    position
        World frame, metres, complex.
    yaw_rad
        Angle from world x.
    """

    samples: int
    position: complex
    yaw_rad: float


Mover = Callable[[Generator, Start, "Motion | None"], Motion]


def apply_lag(commands: Signal, lag_s: float) -> Signal:
    """Filter piecewise constant commands (N,) with a first-order lag, from rest."""
    share = 1.0 - np.exp(-1.0 / (RATE_HZ * lag_s))
    return scan_values(lambda v, u: v + share * (u - v), commands)


def _integrate_rate(rate: Signal, start: complex) -> Signal:
    """Integrate (N,) rates by the trapezoid rule, whose central differences are the mean rates."""
    steps = (rate[1:] + rate[:-1]) / (2 * RATE_HZ)
    return np.concatenate([[start], start + np.cumsum(steps)]).astype(rate.dtype)


def _integrate_motion(start: Start, velocity_own: Plane, yaw_rate: Array) -> Motion:
    """Integrate velocities in the robot's horizontal frame to a motion."""
    yaw = np.real(_integrate_rate(yaw_rate, start.yaw_rad))
    velocity = velocity_own * np.exp(1j * yaw)
    return Motion(_integrate_rate(velocity, start.position), velocity, yaw, yaw_rate)


def _repeat_draws(draws: Signal, hold_s: float, samples: int) -> Signal:
    """Repeat each draw for ``hold_s``, up to (samples,)."""
    held: Signal = draws[(np.arange(samples) / (RATE_HZ * hold_s)).astype(int)]
    return held


def _count_draws(hold_s: float, samples: int) -> int:
    return int(samples / (RATE_HZ * hold_s)) + 2


def back_and_forth(speed_mps: float, yaw_rate_radps: float, hold_s: float) -> Mover:
    """Return a mover that flies a random velocity for a while, and then back.

    Parameters
    ----------
    speed_mps
        Each axis is uniform within plus and minus this, in the robot's horizontal frame.
    yaw_rate_radps
        Uniform within plus and minus this.
    hold_s
        Duration of one direction, seconds.
    """

    def move(rng: Generator, start: Start, _leader: Motion | None) -> Motion:
        count = _count_draws(2 * hold_s, start.samples)
        vx, vy, turn = rng.uniform(-1.0, 1.0, (3, count))
        ways = np.array([1.0, -1.0])
        velocity = np.asarray(speed_mps * np.outer(vx + 1j * vy, ways).ravel(), complex)
        yaw_rate = np.asarray(yaw_rate_radps * np.outer(turn, ways).ravel(), float)
        return _integrate_motion(
            start,
            apply_lag(_repeat_draws(velocity, hold_s, start.samples), VELOCITY_LAG_S),
            apply_lag(_repeat_draws(yaw_rate, hold_s, start.samples), YAW_RATE_LAG_S),
        )

    return move


def follow_in_view(yaw_rate_radps: float) -> Mover:
    """Return a mover that follows changing points in front of the leader.

    Parameters
    ----------
    yaw_rate_radps
        Its yaw rate is uniform within plus and minus this, drawn anew with each point.
    """

    def move(rng: Generator, start: Start, leader: Motion | None) -> Motion:
        assert leader is not None
        count = _count_draws(VIEW_REDRAW_S, start.samples)
        points, turns = draw_view_points(rng, count), rng.uniform(-1.0, 1.0, count)
        ahead = _repeat_draws(points, VIEW_REDRAW_S, start.samples) * np.exp(1j * leader.yaw)
        carried = leader.velocity + 1j * leader.yaw_rate * ahead
        turning = _repeat_draws(turns, VIEW_REDRAW_S, start.samples) * yaw_rate_radps
        return _fly_to(start, leader.position + ahead, carried, turning)

    return move


def fly_in_room(yaw_rate_radps: float) -> Mover:
    """Return a mover that flies to random points of a room whose centre is the origin.

    Parameters
    ----------
    yaw_rate_radps
        Its yaw rate is uniform within plus and minus this, drawn anew with each point.
    """

    def move(rng: Generator, start: Start, _leader: Motion | None) -> Motion:
        x, y, turns = rng.uniform(-1.0, 1.0, (3, _count_draws(ROOM_REDRAW_S, start.samples)))
        points: Plane = np.asarray(ROOM_M / 2 * (x + 1j * y), complex)
        target = _repeat_draws(points, ROOM_REDRAW_S, start.samples)
        turning = _repeat_draws(turns, ROOM_REDRAW_S, start.samples) * yaw_rate_radps
        return _fly_to(start, target, np.zeros_like(target), turning)

    return move


def _fly_to(start: Start, target: Plane, carried: Plane, turning: Array) -> Motion:
    """Return the motion of a robot that starts on a moving target, follows it and turns."""
    yaw_rate = apply_lag(turning, YAW_RATE_LAG_S)
    velocity = _follow_target(target, carried)
    yaw = np.real(_integrate_rate(yaw_rate, start.yaw_rad))
    return Motion(_integrate_rate(velocity, complex(target[0])), velocity, yaw, yaw_rate)


def draw_view_points(rng: Generator, count: int) -> Plane:
    """Draw (count,) points in front of a robot, in its horizontal frame, metres."""
    distance = rng.uniform(*VIEW_DISTANCE_M, count)
    bearing = rng.uniform(-VIEW_BEARING_RAD, VIEW_BEARING_RAD, count)
    return np.asarray(distance * np.exp(1j * bearing))


def _follow_target(target: Plane, carried: Plane) -> Plane:
    """Return the (N,) world velocity of a robot that starts on a moving target and follows it."""
    share = 1.0 - np.exp(-1.0 / (RATE_HZ * VELOCITY_LAG_S))
    position, velocity = complex(target[0]), 0j

    def iter_velocities() -> Iterator[complex]:
        nonlocal position, velocity
        for goal, speed in zip(iter_numbers(target), iter_numbers(carried), strict=True):
            wanted = speed + FOLLOW_GAIN_PER_S * (goal - position)
            wanted *= min(1.0, SPEED_MAX_MPS / max(abs(wanted), 1e-9))
            before = velocity
            velocity += share * (wanted - velocity)
            position += (velocity + before) / (2 * RATE_HZ)
            yield velocity

    return np.fromiter(iter_velocities(), complex, len(target))


def stand_still(_rng: Generator, start: Start, _leader: Motion | None) -> Motion:
    """Return the motion of a robot that does not move."""
    return _integrate_motion(start, np.zeros(start.samples, complex), np.zeros(start.samples))


def hover_in_place(rng: Generator, start: Start, _leader: Motion | None) -> Motion:
    """Return the motion of a hovering robot, with the drift of a small drone: a few centimetres."""
    pushes = rng.normal(0.0, HOVER_SPEED_MPS, (2, _count_draws(1.0, start.samples)))
    # Differences, so that the pushes cancel and the robot stays in place.
    velocity = np.diff(pushes[0] + 1j * pushes[1], prepend=0.0)
    return _integrate_motion(
        start,
        apply_lag(_repeat_draws(velocity, 1.0, start.samples), VELOCITY_LAG_S),
        np.zeros(start.samples),
    )


def fly_parallel(_rng: Generator, start: Start, leader: Motion | None) -> Motion:
    """Return the motion of a robot that copies the leader's motion beside it."""
    assert leader is not None
    position = leader.position + (start.position - leader.position[0])
    return Motion(position, leader.velocity, leader.yaw, leader.yaw_rate)


def fly_rows(rng: Generator, start: Start, _leader: Motion | None) -> Motion:
    """Return the motion of a robot that flies rows in its own frame, then the same rows back."""
    speed = rng.uniform(0.3, 0.6)
    row, gap = ROW_M / speed, ROW_GAP_M / speed
    legs = [(row, (-1) ** k * 1.0) for k in range(ROWS)]
    field = [leg for k in range(ROWS - 1) for leg in (legs[k], (gap, 1j))] + [legs[-1]]
    round_trip = field + [(lasts, -way) for lasts, way in reversed(field)]
    ends = np.cumsum([lasts for lasts, _ in round_trip])
    phase = (np.arange(start.samples) / RATE_HZ) % ends[-1]
    ways = np.array([way for _, way in round_trip])[np.searchsorted(ends, phase, side="right")]
    velocity = apply_lag(speed * ways, VELOCITY_LAG_S)
    return _integrate_motion(start, velocity, np.zeros(start.samples))


def fly_eight(rng: Generator, start: Start, _leader: Motion | None) -> Motion:
    """Return the motion of a robot that flies figures of eight around the world's origin.

    Place, direction and duration of a round are random. Where the round would be faster than
    ``EIGHT_SPEED_MAX_MPS``, the robot flies at that speed, and the round lasts longer.
    """
    round_s, first, heading = rng.uniform(
        (EIGHT_ROUND_S[0], 0.0, 0.0), (EIGHT_ROUND_S[1], 2 * np.pi, 2 * np.pi)
    )
    way = rng.choice((-1.0, 1.0))
    long_m, short_m = EIGHT_HALF_AXES_M

    def seconds_per_rad(phase: Array) -> tuple[Plane, Array]:
        """Return the slope of the curve, metres per radian, and the duration of a radian."""
        slope = long_m * np.cos(phase) + 2j * short_m * np.cos(2 * phase)
        return slope, np.maximum(round_s / (2 * np.pi), np.abs(slope) / EIGHT_SPEED_MAX_MPS)

    time_s = np.arange(start.samples) / RATE_HZ
    rounds = time_s[-1] / round_s + 1.0
    phases = first + np.arange(0.0, 2 * np.pi * rounds, 1e-3)
    lasts_s = np.cumsum(seconds_per_rad(phases[:-1] + 5e-4)[1] * 1e-3)
    phase = np.interp(time_s, np.concatenate([[0.0], lasts_s]), phases)
    slope, pace = seconds_per_rad(phase)
    swing = 2 * np.pi / EIGHT_YAW_S
    angle = swing * time_s + heading
    return Motion(
        long_m * np.sin(way * phase) + 1j * short_m * np.sin(2 * phase) * way,
        way * slope / pace,
        EIGHT_YAW_RAD * np.sin(angle),
        EIGHT_YAW_RAD * swing * np.cos(angle),
    )


TRAJECTORIES: dict[Trajectory, tuple[Mover, Mover]] = {
    "in_view": (back_and_forth(0.5, 0.4, 1.5), follow_in_view(0.8)),
    "random": (back_and_forth(1.0, 0.5, 1.0), back_and_forth(1.0, 0.5, 1.0)),
    "room": (fly_in_room(0.8), fly_in_room(0.8)),
    "lawn_mower": (fly_rows, fly_rows),
    "hover": (hover_in_place, hover_in_place),
    "parallel": (back_and_forth(0.5, 0.4, 1.5), fly_parallel),
    "observer_static": (stand_still, follow_in_view(0.8)),
    "peer_static": (back_and_forth(0.5, 0.4, 1.5), stand_still),
    "no_yaw": (back_and_forth(0.5, 0.0, 1.5), follow_in_view(0.0)),
    "both_static": (stand_still, stand_still),
    "figure_of_eight": (back_and_forth(0.5, 0.4, 1.5), fly_eight),
}
"""Mover of the first robot, and mover of all others."""


def build_truth(motion: Motion, height_m: Array) -> Truth:
    """Build the ground truth of a robot from its motion and height, with the resulting tilt.

    Thrust points along the body's z axis. A robot that accelerates forward pitches nose down, and
    one that accelerates to the left rolls left side down.

    Parameters
    ----------
    motion
        Motion over the floor.
    height_m
        (N,) height above the floor, metres.
    """
    pull_xy = np.gradient(motion.velocity) * RATE_HZ * np.exp(-1j * motion.yaw)
    climb = np.gradient(height_m) * RATE_HZ
    pull_z = GRAVITY_MPS2 + np.gradient(climb) * RATE_HZ
    pitch = np.arctan2(pull_xy.real, pull_z)
    roll = -np.arctan2(pull_xy.imag, np.hypot(pull_xy.real, pull_z))
    return Truth(
        time_s=np.arange(len(height_m)) / RATE_HZ,
        # Axis by axis in memory, so that position_at interpolates without a copy.
        position=np.stack([motion.position.real, motion.position.imag, height_m]).T,
        velocity=np.stack([motion.velocity.real, motion.velocity.imag, climb], axis=1),
        yaw=motion.yaw,
        roll=roll,
        pitch=pitch,
    )
