"""Find odometry and heights that contradict the ranges of a pair, such as after a crash.

Two robots are d1 apart before some time and d2 apart after it. Then their displacements differ by
d1 + d2 at most. If the odometry differs by more, the estimate of the robot with the longer way ran
away. No speed is impossible by itself, so fast flights are not affected.
"""

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation, median_filter, uniform_filter1d

from dmrl.estimation.model.odometry import dead_reckon_path
from dmrl.estimation.model.pair import GRID_RATE_HZ, MAX_DROPOUT_S, Array, Mask, Pair, SensorTrack
from dmrl.estimation.signals.jump_detection import find_held

WINDOWS_S = (0.5, 1.0, 2.0, 4.0)
"""Times over which ways are compared, seconds. An estimate that runs away for less is an outlier,
which the robust loss of the odometry takes."""
MARGIN_M, MARGIN_SHARE = 0.5, 0.25
"""Margin of a contradiction, metres, and share of the way: more than the errors of sound ranges and
of a velocity scale that nobody calibrated."""
RANGE_MEDIAN, RANGE_MEDIAN_S = 21, 1.0
"""Most ranges in the median that a contradiction uses, twice the outliers in a row; and its longest
time, seconds: the distance changes within a longer one."""
SURROUNDING_S = 1.0
"""Time around a contradiction that is dropped too, seconds: it may belong to the fall."""


MAX_ACCELERATION_MPS2 = 30.0
"""Largest sideways acceleration that a log shows over `WINDOWS_S[0]`, m/s^2: three times gravity.
Small drones lift twice their weight. A crashed robot's log spins at 110 m/s^2."""


def drop_held_ranges(pair: Pair) -> Pair:
    """Return the pair without ranges that repeat the one before, of each robot that ranges."""
    held, sender = np.zeros(len(pair.range_m), bool), pair.range_sender
    for robot in (0, 1):
        mine = np.full(len(held), robot == 0) if sender is None else sender == robot
        held[mine] = find_held(pair.range_m[mine])
    if not held.any():
        return pair
    return replace(
        pair, range_time_s=pair.range_time_s[~held], range_m=pair.range_m[~held],
        range_sender=None if sender is None else sender[~held],
    )  # fmt: skip


def drop_contradictions(pair: Pair) -> Pair:
    """Return the pair with contradictory odometry and heights as dropouts.

    A contradiction that lasts to the end of the log is a crash: the robot lies still on the floor.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    """
    if len(pair.range_m) < RANGE_MEDIAN:
        return pair
    ranged = median_filter(pair.range_m, count_median(pair), mode="nearest")
    distance = np.interp(pair.time_s, pair.range_time_s, ranged)
    after = np.clip(np.searchsorted(pair.range_time_s, pair.time_s), 1, len(ranged) - 1)
    gap_s = pair.range_time_s[after] - pair.range_time_s[after - 1]
    distance[gap_s > MAX_DROPOUT_S] = np.inf
    wrong = find_contradictions(pair, distance)
    tracks = [
        _drop_odometry(track, mask, pair.time_s)
        for track, mask in zip((pair.own, pair.peer), wrong, strict=True)
    ]
    up = tracks[1].height_m - tracks[0].height_m
    above = (np.abs(up) > distance + MARGIN_M).nonzero()[0]
    if len(above):
        farther = [np.abs(t.height_m[above] - np.median(t.height_m)).mean() for t in tracks]
        worse = int(farther[1] > farther[0])
        tracks[worse] = _drop_heights(tracks[worse], np.isin(np.arange(len(up)), above))
    return replace(pair, own=tracks[0], peer=tracks[1])


def count_median(pair: Pair) -> int:
    """Return the odd number of ranges whose median shows the distance."""
    per_s = len(pair.range_m) / float(np.ptp(pair.time_s))
    return min(2 * int(per_s * RANGE_MEDIAN_S / 2) + 1, RANGE_MEDIAN)


def find_contradictions(pair: Pair, distance: Array) -> tuple[Mask, Mask]:
    """Return (K,) where the odometry of either robot contradicts the distances.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    distance
        (K,) distance at every time, metres; infinite where it is unknown.
    """
    paths = [dead_reckon_path(track, pair.time_s) for track in (pair.own, pair.peer)]
    speeds = [np.hypot(track.vx_mps, track.vy_mps) for track in (pair.own, pair.peer)]
    wrong = np.stack([_find_spins(track) for track in (pair.own, pair.peer)])
    for window_s in WINDOWS_S:
        reach = round(window_s * GRID_RATE_HZ)
        if reach >= len(pair.time_s):
            continue
        ways = np.stack([np.hypot(*(path[reach:] - path[:-reach]).T) for path in paths])
        allowed = distance[reach:] + distance[:-reach] + MARGIN_M
        excess = np.abs(ways[1] - ways[0]) - MARGIN_SHARE * ways.max(axis=0) - allowed
        for start in np.flatnonzero(excess > 0).tolist():
            robot = int(ways[1, start] > ways[0, start])
            fast = speeds[robot][start : start + reach] > allowed[start] / window_s
            wrong[robot, start : start + reach] |= fast
    around = np.ones(2 * round(SURROUNDING_S * GRID_RATE_HZ) + 1, bool)
    own, peer = (binary_dilation(w, around) if w.any() else w for w in wrong)
    return own, peer


def _find_spins(track: SensorTrack) -> Mask:
    """Return (K,) where a log turns faster than its speed allows: it contradicts itself.

    A spin goes round in circles, so its displacement does not contradict the ranges.
    """
    sideways = np.hypot(track.vx_mps, track.vy_mps) * np.abs(track.yaw_rate_radps)
    size = round(WINDOWS_S[0] * GRID_RATE_HZ)
    return np.asarray(uniform_filter1d(sideways, size) > MAX_ACCELERATION_MPS2)


def _drop_odometry(track: SensorTrack, wrong: Mask, time_s: Array) -> SensorTrack:
    """Return a track with contradictory odometry as dropout, and a crashed robot on the floor."""
    if not wrong.any():
        return track
    wrong, height_m = wrong.copy(), track.height_m.copy()
    last = int(np.flatnonzero(wrong)[-1])
    if time_s[-1] - time_s[last] <= SURROUNDING_S:
        runs = np.flatnonzero(~wrong[: last + 1])
        crash = int(runs[-1]) + 1 if len(runs) else 0
        wrong[crash:] = True
        fallen = crash + round(SURROUNDING_S * GRID_RATE_HZ)
        height_m[fallen:] = 0.0
    known = ~wrong
    turning = None if track.turn_dropout is None else track.turn_dropout | wrong
    return SensorTrack(
        track.vx_mps * known, track.vy_mps * known, track.yaw_rate_radps * known,
        height_m, track.dropout | wrong, track.height_dropout, turning,
    )  # fmt: skip


def _drop_heights(track: SensorTrack, wrong: Mask) -> SensorTrack:
    """Return a track with impossible heights interpolated and marked."""
    good = np.flatnonzero(~wrong)
    if not len(good):
        return track
    height_m = np.interp(np.arange(len(wrong)), good, track.height_m[good])
    before = np.zeros_like(wrong) if track.height_dropout is None else track.height_dropout
    return replace(track, height_m=height_m, height_dropout=before | wrong)
