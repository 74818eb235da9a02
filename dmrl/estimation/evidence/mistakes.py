"""Discrete mistakes of a log, such as a sign or a unit: tried where no noise explains it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from dmrl.estimation.evidence.clock_shifts import ClockShift, is_mutual
from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import (
    MAX_RANGE_M,
    Pair,
    SensorTrack,
    usable_ranges,
)
from dmrl.estimation.search.modes import find_modes
from dmrl.estimation.signals.contradictions import drop_contradictions
from dmrl.estimation.solver.keyframes import build_problem

MISTAKE_S = 50.0
"""Time from the start of a flight in which a mistake is sought, seconds."""
MAX_COST, MISTAKE_RATIO = 0.6, 0.5
"""Largest cost of a keyframe of a flight that fits, and of its cost as logged, which shows a
mistake. Sound simulated flights have 0.2 to 0.3, units that are wrong by a factor of three 0.8.
Sensors that are better than assumed have less: a log without noise 0.04, and 0.25 mirrored."""
ALIKE = 0.05
"""Difference of the costs of a keyframe within which two corrections fit alike: twelve over the
sought stretch. A yaw rate taken as degrees hardly turns, so velocities in the world frame fit it as
well: the costs differed by 0.005 there, and by 0.14 to 4 where another mistake was the true one."""
DROPPED_COST = 2.0
"""Cost of a keyframe without odometry: what is dropped fits everything."""
SHIFTS_S, FINE_SHIFTS_S = (-4.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0), (0.5, 0.25)
"""Shifts of a clock that are tried where one robot ranges alone, seconds; and their halvings."""
FOOT_M = 0.3048
"""Length of a foot, metres."""
MAX_SPEED_MPS, MAX_HEIGHT_M = 5.0, 10.0
"""Medians of a speed and a height beyond which centimetres and millimetres are tried."""

OF_ONE_ROBOT, OF_BOTH_ROBOTS = " of one robot ", " of both robots "
"""Words of a mistake of either of two logs, and of one of both."""

Correction = Callable[[Pair, int | None], Pair]
"""Function from a pair and the robot with the wrong log to the corrected pair."""


@dataclass(frozen=True, slots=True)
class Mistake:
    """A way in which a log is written wrongly.

    Parameters
    ----------
    name
        Name of the cause.
    correct
        The correction.
    robots
        Robots that it may concern. None: the pair.
    applies
        Whether it is tried, by the pair and the robot. None: always.
    heading_is_open
        Whether the robot's heading remains unknown by a constant angle.
    shift
        Shift of the second robot's clock. None: its times stay.
    with_camera
        Whether it is tried where a camera shows the peer alone, or only elsewhere. None: always.
    in_both
        Robots that cannot tell where the peer is if both logs have it. None: not tried in both.
    """

    name: str
    correct: Correction
    robots: tuple[int | None, ...] = (0, 1)
    applies: Callable[[Pair, int | None], bool] | None = None
    heading_is_open: bool = False
    shift: ClockShift | None = None
    with_camera: bool | None = None
    in_both: tuple[int, ...] | None = None


class FoundMistake(NamedTuple):
    """A mistake, its robot (None: the pair), and the robots that cannot tell where the peer is."""

    mistake: Mistake
    robot: int | None
    blind: tuple[int, ...] = ()


def find_mistake(pair: Pair) -> FoundMistake | None:
    """Find the discrete mistake without which a flight fits; None if there is none.

    Parameters
    ----------
    pair
        Sensor data of both robots, which no noise explains.
    """
    part = pair.crop(pair.time_s[0], pair.time_s[0] + MISTAKE_S)

    def compute_cost(choice: tuple[Mistake, int | None]) -> float:
        return compute_misfit(choice[0].correct(part, choice[1]))

    enough = min(MAX_COST, MISTAKE_RATIO * compute_misfit(part))
    every = [
        (one, robot)
        for one in MISTAKES
        for robot in (*one.robots, *([] if one.in_both is None else [None]))
        if one.with_camera in (None, has_camera(pair, robot))
        and (one.applies is None or one.applies(pair, robot))
    ]
    # What the measurements show by themselves comes first.
    shown = [choice for choice in every if choice[0].applies]
    for some in (shown, [choice for choice in every if choice not in shown]):
        costs = [compute_cost(choice) for choice in some]
        if costs and min(costs) < enough:
            order = np.argsort(costs, kind="stable").tolist()
            return _select(pair, [some[k] for k in order if costs[k] < min(costs) + ALIKE])
    if is_mutual(pair):
        return None
    moved = _move_clock(_search_shift(lambda shift_s: compute_cost(_move_clock(shift_s))))
    return FoundMistake(*moved) if compute_cost(moved) < enough else None


def _select(pair: Pair, alike: list[tuple[Mistake, int | None]]) -> FoundMistake:
    """Return the correction to make of those that fit alike, best first."""
    # A mistake in one log is likelier than one in both.
    single = [(one, robot) for one, robot in alike if robot in one.robots]
    if not single:
        mistake, _ = alike[0]
        name = mistake.name.replace(" fit", f"{OF_BOTH_ROBOTS}fit", 1)
        return FoundMistake(replace(mistake, name=name), None, mistake.in_both or ())
    mistake, robot = next((one for one in single if one[0].heading_is_open), single[0])
    if {(mistake, 0), (mistake, 1)} <= set(single):
        # Either robot may be the mirrored one, so nothing shows on which side the peer is.
        name = mistake.name.replace(" fit", f"{OF_ONE_ROBOT}fit", 1)
        return FoundMistake(replace(mistake, name=name), None, (0, 1))
    if robot is not None and mistake.heading_is_open and not has_camera(pair, robot):
        return FoundMistake(mistake, robot, (robot,))
    return FoundMistake(mistake, robot)


def compute_misfit(pair: Pair) -> float:
    """Return the cost of a keyframe of the best solution of a coarse copy of a flight."""
    if not len(pair.range_m) and pair.own_bearings is pair.peer_bearings is None:
        return np.inf
    used = drop_contradictions(pair)
    problem = build_problem({(0, 1): used})
    dropped = (used.own.dropout | used.peer.dropout).mean()
    dropped -= (pair.own.dropout | pair.peer.dropout).mean()
    cost = find_modes(problem)[0].cost / len(problem.keyframe_s)
    return float(cost + DROPPED_COST * dropped)


def _move_clock(shift_s: float) -> tuple[Mistake, int | None]:
    """Return the mistake of a second clock that is off by seconds, and its robot."""
    shift = ClockShift(shift_s)
    return Mistake(shift.name, lambda pair, _robot: shift.move(pair), (1,), shift=shift), 1


def _search_shift(compute_cost: Callable[[float], float]) -> float:
    """Return the shift of the second robot's clock with the least cost, seconds."""
    best_s = min(SHIFTS_S, key=compute_cost)
    for step_s in FINE_SHIFTS_S:
        best_s = min([best_s, best_s - step_s, best_s + step_s], key=compute_cost)
    return best_s


def _correct_track(change: Callable[[SensorTrack, float], SensorTrack]) -> Correction:
    """Return the correction of a log, or of both for robot None, from the log and its step."""

    def correct(pair: Pair, robot: int | None) -> Pair:
        tracks = [
            track if robot == other else change(track, pair.dt_s)
            for track, other in ((pair.own, 1), (pair.peer, 0))
        ]
        return replace(pair, own=tracks[0], peer=tracks[1])

    return correct


def _scale(factor: float, *names: str) -> Correction:
    """Return the correction that multiplies signals of a robot."""
    return _correct_track(
        lambda track, _: replace(track, **{name: factor * getattr(track, name) for name in names})
    )


def _scale_ranges(factor: float) -> Correction:
    """Return the correction that multiplies the ranges."""

    def correct(pair: Pair, _robot: int | None) -> Pair:
        range_m = factor * pair.range_m
        good = usable_ranges(pair.range_time_s, range_m)
        sender = None if pair.range_sender is None else pair.range_sender[good]
        return replace(
            pair, range_time_s=pair.range_time_s[good], range_m=range_m[good], range_sender=sender
        )

    return correct


def _from_take_off_frame(track: SensorTrack, dt_s: float) -> SensorTrack:
    """Return a log whose velocities were in the frame of the take-off."""
    heading = np.cumsum(track.yaw_rate_radps) * dt_s
    velocity = np.column_stack([track.vx_mps, track.vy_mps])
    x, y = rotate(rotation_matrix(-heading), velocity).T
    return replace(track, vx_mps=x, vy_mps=y)


def _swap_axes(track: SensorTrack, _dt_s: float) -> SensorTrack:
    """Return a log whose velocities were exchanged."""
    return replace(track, vx_mps=track.vy_mps, vy_mps=track.vx_mps)


def _exchange_logs(pair: Pair, _robot: int | None) -> Pair:
    """Return a pair whose robots have each other's log."""
    return replace(pair, own=pair.peer, peer=pair.own)


def _is_fast(pair: Pair, robot: int | None) -> bool:
    """Return whether no robot flies at the logged speed."""
    track = (pair.own, pair.peer)[robot or 0]
    return bool(np.median(np.hypot(track.vx_mps, track.vy_mps)) > MAX_SPEED_MPS)


def _is_high(pair: Pair, robot: int | None) -> bool:
    """Return whether no robot flies at the logged height."""
    return bool(np.median((pair.own, pair.peer)[robot or 0].height_m) > MAX_HEIGHT_M)


def ranges_are_far(pair: Pair, _robot: int | None = None) -> bool:
    """Return whether no radio measures the logged ranges, if they are in metres."""
    return bool(len(pair.range_m) and np.median(pair.range_m) > MAX_RANGE_M)


def has_camera(pair: Pair, robot: int | None) -> bool:
    """Return whether a robot's detections show the peer in its frame; None: any robot's."""
    views = (pair.own_bearings, pair.peer_bearings)
    return any(view is not None for view in (views if robot is None else [views[robot]]))


FLOW, TURN = ("vx_mps", "vy_mps"), "yaw_rate_radps"
PAIR = (None,)
MISTAKES: tuple[Mistake, ...] = (
    Mistake("yaw rate fits if it is negated", _scale(-1.0, TURN), in_both=(0, 1)),
    Mistake("odometry fits if vy and yaw rate are negated", _scale(-1.0, "vy_mps", TURN)),
    Mistake("yaw rate fits if it is taken as degrees", _scale(np.pi / 180, TURN), in_both=()),
    # Three mirrors that differ by a turn of the robot's frame, which ranges do not show.
    Mistake(
        "flow fits if one axis is negated or both are swapped",
        _scale(-1.0, "vx_mps"),
        heading_is_open=True,
        with_camera=False,
    ),
    Mistake("flow fits if vx is negated", _scale(-1.0, "vx_mps"), with_camera=True),
    Mistake("flow fits if vy is negated", _scale(-1.0, "vy_mps"), with_camera=True),
    Mistake("flow fits if vx and vy are swapped", _correct_track(_swap_axes), with_camera=True),
    Mistake(
        "flow fits in the world frame",
        _correct_track(_from_take_off_frame),
        heading_is_open=True,
        in_both=(0, 1),
    ),
    Mistake("flow fits if it is taken as feet", _scale(FOOT_M, *FLOW), in_both=()),
    Mistake("range fits if it is taken as feet", _scale_ranges(FOOT_M), PAIR),
    Mistake("robots fit if their logs are exchanged", _exchange_logs, PAIR, with_camera=True),
    *(
        mistake
        for size in (100, 1000)
        for mistake in (
            Mistake(
                f"range fits if it is divided by {size}",
                _scale_ranges(1 / size),
                PAIR,
                ranges_are_far,
            ),
            Mistake(
                f"flow fits if it is divided by {size}", _scale(1 / size, *FLOW), applies=_is_fast
            ),
            Mistake(
                f"height fits if it is divided by {size}",
                _scale(1 / size, "height_m"),
                applies=_is_high,
            ),
        )
    ),
)
