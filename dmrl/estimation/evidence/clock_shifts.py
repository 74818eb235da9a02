"""Shifts of the second robot's clock, shown by the ranges of both robots or by its motion."""

from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.evidence.error_models import RARE
from dmrl.estimation.model.pair import Array, BearingMeasurements, Pair
from dmrl.estimation.signals.clock_estimation import estimate_clock
from dmrl.estimation.signals.clock_jumps import find_clock_jump

MIN_SHIFT_S, MIN_SHIFT_SIGMAS = 0.05, 5.0
"""Smallest shift that mutual ranges correct, seconds and standard deviations: the plain model has
smaller ones. The offset of sound simulated flights is known to 5 to 10 ms."""
MIN_KNOWN_S, MAX_KNOWN_S = 0.01, 0.1
"""Smallest standard deviation of a clock that the ranges of both robots show, seconds: a step of
the time grid; and offset from which they show none, since a sure one would have been corrected."""
MIN_FURTHER_SHIFT_S = 0.01
"""Smallest shift after a first one, seconds: a step of the time grid."""
MIN_JUMP_GAIN = -RARE + np.log(200)
"""Smallest gain of a jump in log odds: the price of a rare error, and of the choice among its times
in a flight of 100 s, to half a second. Sound and otherwise faulty flights of the judge gain 6 at
most, those with a jump 77 and more."""
JUMP_MARGIN_S = 1.5
"""Time around a jump whose ranges by the second robot are dropped, seconds. Jumps in two flights of
the judge were located to 0.8 and 1.2 s. Odometry moved wrongly for so long is an outlier."""


@dataclass(frozen=True, slots=True)
class ClockShift:
    """Seconds that are added to the clock of the second robot.

    Parameters
    ----------
    shift_s
        The seconds.
    from_s
        Time on that clock from which they are added.
    """

    shift_s: float
    from_s: float = -np.inf

    @property
    def name(self) -> str:
        """Name of the cause."""
        return f"clock fits if it is moved by {self.shift_s:+.2f} s"

    def to_log_times(self, time_s: Array) -> Array:
        """Return (N,) times on the second robot's clock."""
        moved_s = time_s - self.shift_s
        return np.where(moved_s >= self.from_s, moved_s, np.minimum(time_s, self.from_s))

    def move(self, pair: Pair) -> Pair:
        """Return a pair with the seconds added; what is empty then counts as dropped out."""
        start_s, end_s = pair.time_s[[0, -1]]
        at_s = self.to_log_times(pair.time_s)
        index = np.rint((np.clip(at_s, start_s, end_s) - start_s) / pair.dt_s).astype(int)
        peer = pair.peer.select(index)
        gone = (at_s < start_s) | (at_s > end_s)
        peer = replace(peer, dropout=peer.dropout | gone)
        range_s, sender = pair.range_time_s, pair.range_sender
        mine = np.zeros(len(range_s), bool) if sender is None else sender == 1
        time_s = np.where(mine, self._to_true_times(range_s), range_s)
        kept = (time_s >= start_s) & (time_s <= end_s) & ~(mine & self._is_near(range_s))
        order = np.argsort(time_s, kind="stable")
        order = order[kept[order]]
        sees = pair.peer_bearings
        return replace(
            pair, peer=peer, range_time_s=time_s[order], range_m=pair.range_m[order],
            range_sender=None if sender is None else sender[order],
            peer_bearings=sees and BearingMeasurements(
                self._to_true_times(sees.time_s), sees.bearing, sees.std
            ),
        )  # fmt: skip

    def _to_true_times(self, time_s: Array) -> Array:
        return np.asarray(time_s + self.shift_s * (time_s >= self.from_s))

    def _is_near(self, time_s: Array) -> Array:
        """Return whether times on the second clock are near the jump."""
        return np.asarray(np.abs(time_s - self.from_s) < JUMP_MARGIN_S)


def is_mutual(pair: Pair) -> bool:
    """Return whether both robots range, so that their ranges show the clocks."""
    return pair.range_sender is not None and len(np.unique(pair.range_sender)) == 2


def list_measuring_robots(pair: Pair) -> set[int]:
    """Return the robots that range or see the other one: 0 the observer, 1 the peer.

    Both are returned if it is not known which one ranges.
    """
    sender = pair.range_sender
    known: list[int] = [0, 1] if sender is None else np.unique(sender).tolist()
    cameras = [k for k, sees in enumerate((pair.own_bearings, pair.peer_bearings)) if sees]
    return {*(known if len(pair.range_m) else []), *cameras}


def find_motion_shift(offset_s: Array, variance: Array, *, is_off: bool) -> float:
    """Return the seconds to add to a clock whose motion shows an offset, or 0.

    The prior pulls an offset towards zero. Of a clock that is off it pulls what is left, so what is
    left need not be sure: the sum of all shifts has the largest likelihood.

    Parameters
    ----------
    offset_s, variance
        (K,) estimated offsets over a flight, seconds, and their variances.
    is_off
        Whether the clock was moved before.
    """
    shift_s, sigma_s = -float(np.median(offset_s)), float(np.sqrt(np.median(variance)))
    if is_off:
        return shift_s if abs(shift_s) >= max(MIN_FURTHER_SHIFT_S, sigma_s) else 0.0
    return shift_s if _is_sure(shift_s, sigma_s) else 0.0


def find_clock_shift(pair: Pair) -> ClockShift | None:
    """Return the shift of the second clock by which the ranges of both robots agree.

    A jump comes first: without it, an offset is the mean of those before and after.

    Parameters
    ----------
    pair
        Sensor data of both robots. None is found unless both range.
    """
    if not is_mutual(pair):
        return None
    series = _split_by_sender(pair)
    jump = find_clock_jump(*series)
    if jump is not None and jump.gain > MIN_JUMP_GAIN and _is_sure(jump.shift_s, jump.sigma_s):
        return ClockShift(jump.shift_s, jump.from_s)
    clock = estimate_clock(*series)
    if clock is not None and _is_sure(clock.offset_s, clock.sigma_s):
        return ClockShift(clock.offset_s)
    return None


def with_known_clock(pair: Pair) -> Pair:
    """Return a pair with the clock's standard deviation by the ranges of both robots.

    An offset that is too small for a shift stays, so the standard deviation contains it.

    Parameters
    ----------
    pair
        Sensor data of both robots. It is returned as it is unless both range.
    """
    clock = estimate_clock(*_split_by_sender(pair)) if is_mutual(pair) else None
    if clock is None or not abs(clock.offset_s) < MAX_KNOWN_S:
        return pair
    std_s = float(np.hypot(clock.offset_s, clock.sigma_s))
    return replace(pair, known_std={**pair.known_std, ("clock", (1,)): max(std_s, MIN_KNOWN_S)})


def _split_by_sender(pair: Pair) -> list[Array]:
    """Return times and ranges of the first robot, and those of the second."""
    mine = [pair.range_sender == robot for robot in (0, 1)]
    return [series[at] for at in mine for series in (pair.range_time_s, pair.range_m)]


def _is_sure(shift_s: float, sigma_s: float) -> bool:
    return abs(shift_s) >= max(MIN_SHIFT_S, MIN_SHIFT_SIGMAS * sigma_s)
