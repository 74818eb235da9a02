"""Discrete mistakes of a log, such as a sign: tried where no noise explains it."""

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
        Corrected log of one robot, from the log and its step, seconds.
    heading_is_open
        Whether the robot's heading remains unknown by a constant angle.
    """

    name: str
    correct: Callable[[SensorTrack, float], SensorTrack]
    heading_is_open: bool = False

    def apply(self, pair: Pair, robot: int) -> Pair:
        """Return the pair with the corrected log of a robot."""
        tracks = [pair.own, pair.peer]
        tracks[robot] = self.correct(tracks[robot], pair.dt_s)
        return replace(pair, own=tracks[0], peer=tracks[1])


def _from_take_off_frame(track: SensorTrack, dt_s: float) -> SensorTrack:
    """Return a log whose velocities were in the frame of the take-off."""
    heading = np.cumsum(track.yaw_rate_radps) * dt_s
    velocity = np.column_stack([track.vx_mps, track.vy_mps])
    x, y = rotate(rotation_matrix(-heading), velocity).T
    return replace(track, vx_mps=x, vy_mps=y)


def _negate(name: str) -> Callable[[SensorTrack, float], SensorTrack]:
    """Return the correction that negates a signal."""

    def correct(track: SensorTrack, _dt_s: float) -> SensorTrack:
        return replace(track, **{name: -getattr(track, name)})

    return correct


MISTAKES: tuple[Mistake, ...] = (
    Mistake("yaw rate fits if it is negated", _negate("yaw_rate_radps")),
    Mistake("flow fits if vx is negated", _negate("vx_mps")),
    Mistake("flow fits if vy is negated", _negate("vy_mps")),
    Mistake(
        "flow fits if vx and vy are swapped",
        lambda track, _: replace(track, vx_mps=track.vy_mps, vy_mps=track.vx_mps),
    ),
    Mistake("flow fits in the world frame", _from_take_off_frame, heading_is_open=True),
)
