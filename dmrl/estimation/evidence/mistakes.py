"""Discrete mistakes of a log, such as a sign or a unit: tried where no noise explains it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import Pair, SensorTrack


@dataclass(frozen=True, slots=True)
class Mistake:
    """A way in which a log is written wrongly.

    Parameters
    ----------
    name
        Name of the cause.
    correct
        Corrected log of one robot, from the log and its times. None: of the ranges.
    range_unit_m
        Unit of the ranges, metres.
    heading_is_open
        Whether the robot's heading remains unknown by a constant angle.
    """

    name: str
    correct: Callable[[SensorTrack, float], SensorTrack] | None = None
    range_unit_m: float = 1.0
    heading_is_open: bool = False

    def apply(self, pair: Pair, robot: int | None) -> Pair:
        """Return the corrected pair."""
        if self.correct is None or robot is None:
            return replace(pair, range_m=pair.range_m * self.range_unit_m)
        tracks = [pair.own, pair.peer]
        tracks[robot] = self.correct(tracks[robot], pair.dt_s)
        return replace(pair, own=tracks[0], peer=tracks[1])


def _from_take_off_frame(track: SensorTrack, dt_s: float) -> SensorTrack:
    """Return a log whose velocities were in the frame of the take-off."""
    heading = np.cumsum(track.yaw_rate_radps) * dt_s
    velocity = np.column_stack([track.vx_mps, track.vy_mps])
    x, y = rotate(rotation_matrix(-heading), velocity).T
    return replace(track, vx_mps=x, vy_mps=y)


def _scale(field: str, factor: float) -> Callable[[SensorTrack, float], SensorTrack]:
    """Return the correction that multiplies signals."""

    def correct(track: SensorTrack, _dt_s: float) -> SensorTrack:
        return replace(track, **{name: factor * getattr(track, name) for name in field.split()})

    return correct


MISTAKES: tuple[Mistake, ...] = (
    Mistake("yaw rate fits if it is negated", _scale("yaw_rate_radps", -1.0)),
    Mistake("yaw rate fits in degrees", _scale("yaw_rate_radps", float(np.pi / 180))),
    Mistake("flow fits if vx is negated", _scale("vx_mps", -1.0)),
    Mistake("flow fits if vy is negated", _scale("vy_mps", -1.0)),
    Mistake(
        "flow fits if vx and vy are swapped",
        lambda track, _: replace(track, vx_mps=track.vy_mps, vy_mps=track.vx_mps),
    ),
    Mistake("flow fits in cm/s", _scale("vx_mps vy_mps", 0.01)),
    Mistake("flow fits in the world frame", _from_take_off_frame, heading_is_open=True),
    Mistake("range fits in feet", range_unit_m=0.3048),
    Mistake("range fits in cm", range_unit_m=0.01),
)
