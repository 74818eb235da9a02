"""Solve a flight with long dropouts of ranges or odometry segment by segment.

Dead reckoning through a dropout is off by a metre. The rest of the flight may then fit on the wrong
side of the observer as well as on the right one. So every segment between dropouts is also solved
by itself, and the joined segments are an initial guess of the whole flight. If a segment alone is
confident and the whole flight contradicts it, the segment is kept.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from dmrl.estimation.model.bearings import crop_to_time
from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import Array, Mask, Pair, SensorTrack
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver.covariance import integrate_path
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import KeyframeProblem

MIN_DROPOUT_S = 3.0
"""Shortest dropout of ranges or odometry that splits a flight, seconds. No record of how the value
was chosen."""
MIN_SEGMENT_S, MIN_SEGMENT_RANGES = 10.0, 20
"""Shortest segment, seconds, and fewest ranges of a segment that is solved by itself. No record of
how the values were chosen."""
CONSISTENCY_PROBABILITY, MAX_OUTSIDE_SHARE = 0.99, 0.2
"""A solution is rejected if more than the second share of another one's OK positions have it
outside their ellipse of the first probability. No record of how the values were chosen."""


def is_inconsistent(whole: Estimate, sure: Estimate) -> bool:
    """Return whether a solution fails a chi-square test against another one's confident positions.

    Parameters
    ----------
    whole
        Solution to test.
    sure
        Another solution of the same ordered pair, of the same time or a part of it.
    """
    xy, _, _ = whole.interpolate_at(sure.time_s)
    known = sure.status == OK
    if not known.any():
        return False
    apart = (xy - sure.state[:, :2])[known]
    information = np.linalg.inv(sure.covariance[known, :2, :2])
    # Squared Mahalanobis distances are chi-square with two degrees of freedom if both are right.
    squared = np.einsum("ki,kij,kj->k", apart, information, apart)
    return bool((squared > chi2.ppf(CONSISTENCY_PROBABILITY, 2)).mean() > MAX_OUTSIDE_SHARE)


def split_at_dropouts(pair: Pair) -> list[Pair]:
    """Split a flight at long dropouts; return no segment if there is no such dropout.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    """
    heard_s = np.concatenate([pair.time_s[:1], pair.range_time_s, pair.time_s[-1:]])
    after = np.searchsorted(heard_s[1:-1], pair.time_s) + 1
    silent = heard_s[after] - heard_s[after - 1] > MIN_DROPOUT_S
    edges = np.diff(
        np.concatenate([[False], pair.own.dropout | pair.peer.dropout, [False]]).astype(int)
    )
    for start, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
        if (end - start) * pair.dt_s > MIN_DROPOUT_S:
            silent[start:end] = True
    if not silent.any():
        return []
    ends = np.flatnonzero(np.diff(np.concatenate([[True], silent, [True]]).astype(int)))
    parts = [(pair.time_s[a], pair.time_s[b - 1]) for a, b in ends.reshape(-1, 2)]
    made = [_crop_pair(pair, a, b) for a, b in parts if b - a >= MIN_SEGMENT_S]
    return [part for part in made if len(part.range_m) >= MIN_SEGMENT_RANGES]


def join_segments(flight: KeyframeProblem, parts: Sequence[Estimate]) -> Array:
    """Join solved segments to states (K, 6) of the whole flight, by dead reckoning in between.

    Parameters
    ----------
    flight
        Keyframes of the whole flight.
    parts
        Estimates of one segment or more, in order of time.
    """
    key_s, (heading, place), (turned, way) = (
        flight.keyframe_s,
        integrate_path(flight.own),
        integrate_path(flight.peer),
    )
    ways = []
    for part in parts:
        at = np.flatnonzero((key_s >= part.time_s[0]) & (key_s <= part.time_s[-1]))
        columns = (*part.state[:, :2].T, np.unwrap(part.state[:, 2]))
        known = np.column_stack([np.interp(key_s[at], part.time_s, c) for c in columns])
        seen = rotate(rotation_matrix(heading[at]), known[:, :2]) + place[at]
        # Before and after the segment the peer follows its odometry, from either end.
        near = np.clip(np.arange(len(key_s)), at[0], at[-1]) - at[0]
        turn = (heading[at] + known[:, 2] - turned[at])[near]
        there = seen[near] + rotate(rotation_matrix(turn), way - way[at][near])
        ways.append((at[0], at[-1], np.column_stack([there, turn + turned - heading])))
    state = ways[0][2]
    for (_, last, _), (first, _, track) in pairwise(ways):
        track[:, 2] += 2 * np.pi * np.round((state[first, 2] - track[first, 2]) / (2 * np.pi))
        share = np.clip((np.arange(len(key_s)) - last) / (first - last), 0.0, 1.0)[:, None]
        state = (1 - share) * state + share * track
    xy = rotate(rotation_matrix(-heading), state[:, :2] - place)
    return np.column_stack(
        [xy, state[:, 2], np.zeros((len(key_s), 2)), _range_errors(key_s, parts)]
    )


def _range_errors(key_s: Array, parts: Sequence[Estimate]) -> Array:
    """Return (K,) range errors of the segments; 0 between them."""
    out = np.zeros(len(key_s))
    for part in parts:
        at = (key_s >= part.time_s[0]) & (key_s <= part.time_s[-1])
        if part.range_error_m is not None:
            out[at] = np.interp(key_s[at], part.time_s, part.range_error_m)
    return out


def prefer_confident_segments(
    both: tuple[Estimate, Estimate], parts: Sequence[tuple[Estimate, Estimate]]
) -> tuple[Estimate, Estimate]:
    """Replace parts of a solution that contradict a confident segment, in both directions.

    Parameters
    ----------
    both
        Estimates of the whole flight, of either robot.
    parts
        Estimates of its segments.
    """
    here, there = both
    for own, peer in parts:
        if is_inconsistent(here, own) or is_inconsistent(there, peer):
            here, there = _replace_segment(here, own), _replace_segment(there, peer)
    return here, there


def _replace_segment(whole: Estimate, part: Estimate) -> Estimate:
    """Return the estimate of the whole flight with one segment replaced."""
    at = (whole.time_s >= part.time_s[0]) & (whole.time_s <= part.time_s[-1])
    time_s = whole.time_s[at]
    near = np.clip(np.searchsorted(part.time_s, time_s), 0, len(part.time_s) - 1)
    columns = (*part.state[:, :2].T, np.unwrap(part.state[:, 2]))
    state, covariance, status = whole.state.copy(), whole.covariance.copy(), whole.status.copy()
    state[at] = np.column_stack([np.interp(time_s, part.time_s, column) for column in columns])
    covariance[at], status[at] = part.covariance[near], part.status[near]
    return replace(whole, state=state, covariance=covariance, status=status)


def _crop_pair(pair: Pair, start_s: float, end_s: float) -> Pair:
    """Crop a pair to an interval."""
    at = (pair.time_s >= start_s) & (pair.time_s <= end_s)
    time_s = pair.time_s[at]
    inside = (pair.range_time_s >= time_s[0]) & (pair.range_time_s <= time_s[-1])
    own_sees, peer_sees = (
        crop_to_time(seen, time_s[0], time_s[-1])
        for seen in (pair.own_bearings, pair.peer_bearings)
    )
    return Pair(
        time_s,
        _crop_track(pair.own, at),
        _crop_track(pair.peer, at),
        pair.range_time_s[inside],
        pair.range_m[inside],
        own_sees,
        peer_sees,
        pair.calibrated_std,
    )


def _crop_track(track: SensorTrack, at: Mask) -> SensorTrack:
    """Crop the signals of one robot."""
    vx, vy, yaw_rate, height = (signal[at] for signal in track.signals())
    silent = None if track.height_dropout is None else track.height_dropout[at]
    return SensorTrack(vx, vy, yaw_rate, height, track.dropout[at], silent)
