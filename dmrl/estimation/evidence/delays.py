"""Move a late signal by its estimated delay.

An error model of a delay is linear: a delayed motion is the motion less its derivative times the
delay. That holds for a part of the time in which the motion changes. Where a longer delay is
probable, the signal is moved by the estimate, and the flight is solved again. The remaining
delay is then an unknown of the flight.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.evidence.clock_shifts import MIN_SHIFT_S
from dmrl.estimation.evidence.error_models import Candidate
from dmrl.estimation.evidence.posterior import Mixture
from dmrl.estimation.model.pair import Array, Pair, SensorTrack

SIGNALS = {
    "flow_delay": ("vx_mps", "vy_mps"),
    "yaw_rate_delay": ("yaw_rate_radps",),
    "range_delay": (),
}
"""Signals of a robot that each unknown delays; none: the ranges of the pair."""
MIN_PROBABILITY, MIN_DELAY_SIGMAS = 0.5, 2.0
"""Smallest probability of the error model of a delay that is moved, and smallest delay in standard
deviations. What is moved too far comes back, since the delay remains an unknown."""


@dataclass(frozen=True, slots=True)
class Delay:
    """A late signal.

    Parameters
    ----------
    unknown
        Name of the unknown, a key of `SIGNALS`.
    model
        Its error model, and the robot with the late signal.
    delay_s
        Estimated delay, seconds.
    """

    unknown: str
    model: Candidate
    delay_s: float


def find_delay(
    mixture: Mixture, constants_covariance: Array, late: Sequence[Candidate] = ()
) -> Delay | None:
    """Return the first delay of a window that is probable and too long for a linear model.

    Models are combined greedily, so that the first explains most. Further delays can stand for
    what the linear model of the first one leaves.

    Parameters
    ----------
    mixture
        Solutions of the window under likely models.
    constants_covariance
        (G, G) covariance of the constants of the best solution.
    late
        Models of signals that were moved: their remaining delays need not be sure.
    """
    best, probable = mixture.members[0], mixture.probabilities()
    for model in (*late, *best.models):
        for name in (row.name for row in model.model.rows if row.name in SIGNALS):
            owners = (0, 1) if model.robot is None else (model.robot,)
            k = best.solver.problem.layout.find(name, *owners)
            delay_s, sigma_s = best.values.constants[k], np.sqrt(constants_covariance[k, k])
            sure = model in late or (
                abs(delay_s) >= MIN_DELAY_SIGMAS * sigma_s and probable[model] >= MIN_PROBABILITY
            )
            if sure and abs(delay_s) >= MIN_SHIFT_S:
                return Delay(name, model, float(delay_s))
    return None


def join_delays(windows: Sequence[Delay | None]) -> Delay | None:
    """Return the delay that most windows of a flight have, with the median of its estimates.

    Parameters
    ----------
    windows
        Delay of each window.
    """
    every: dict[tuple[str, Candidate], list[float]] = {}
    for delay in windows:
        if delay is not None:
            every.setdefault((delay.unknown, delay.model), []).append(delay.delay_s)
    for key, found_s in every.items():
        if 2 * len(found_s) > len(windows):
            return Delay(*key, float(np.median(found_s)))
    return None


def move_signal(pair: Pair, delay: Delay) -> Pair:
    """Return a pair whose late signal has the times at which it was measured.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    delay
        The delay. What it leaves empty at an end of the log counts as dropped out.
    """
    names = SIGNALS[delay.unknown]
    if not names:
        time_s = pair.range_time_s - delay.delay_s
        kept = (time_s >= pair.time_s[0]) & (time_s <= pair.time_s[-1])
        sender = None if pair.range_sender is None else pair.range_sender[kept]
        return replace(
            pair, range_time_s=time_s[kept], range_m=pair.range_m[kept], range_sender=sender
        )
    steps = round(delay.delay_s / pair.dt_s)
    if delay.model.robot == 0:
        return replace(pair, own=_move_track(pair.own, names, steps))
    return replace(pair, peer=_move_track(pair.peer, names, steps))


def _move_track(track: SensorTrack, names: Sequence[str], steps: int) -> SensorTrack:
    """Return a track with some signals earlier by a number of samples."""
    at = np.arange(len(track.dropout)) + steps
    index = np.clip(at, 0, len(at) - 1)
    gone = track.dropout[index] | (at != index)
    moved = {name: getattr(track, name)[index] for name in names}
    turn = track.turn_dropout
    if turn is not None and "yaw_rate_radps" in names:
        turn = turn | turn[index] | (at != index)
    return replace(track, **moved, dropout=track.dropout | gone, turn_dropout=turn)
