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

from dmrl.estimation.model.bearings import within
from dmrl.estimation.model.odometry import rotate, rotation
from dmrl.estimation.model.pair import Array, Mask, Pair, Track
from dmrl.estimation.model.status import OK
from dmrl.estimation.solver.covariance import path_of
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import Problem

SILENCE_S = 3.0
"""Shortest dropout of ranges or odometry that splits a flight, seconds. No record of how the value
was chosen."""
LEAST_S, LEAST_RANGES = 10.0, 20
"""Shortest segment, seconds, and fewest ranges of a segment that is solved by itself. No record of
how the values were chosen."""
INSIDE, CONTRADICTED = 0.99, 0.2
"""A solution is rejected if more than the second share of another one's OK positions have it
outside their ellipse of the first probability. No record of how the values were chosen."""


def contradicts(whole: Estimate, sure: Estimate) -> bool:
    """Return whether a solution fails a chi-square test against another one's confident positions.

    Parameters
    ----------
    whole
        Solution to test.
    sure
        Another solution of the same ordered pair, of the same time or a part of it.
    """
    xy, _, _ = whole.at(sure.time_s)
    known = sure.status == OK
    if not known.any():
        return False
    apart = (xy - sure.state[:, :2])[known]
    information = np.linalg.inv(sure.covariance[known, :2, :2])
    # Squared Mahalanobis distances are chi-square with two degrees of freedom if both are right.
    squared = np.einsum("ki,kij,kj->k", apart, information, apart)
    return bool((squared > chi2.ppf(INSIDE, 2)).mean() > CONTRADICTED)


def stretches(pair: Pair) -> list[Pair]:
    """Split a flight at long dropouts; return no segment if there is no such dropout.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    """
    heard_s = np.concatenate([pair.time_s[:1], pair.range_time_s, pair.time_s[-1:]])
    after = np.searchsorted(heard_s[1:-1], pair.time_s) + 1
    silent = heard_s[after] - heard_s[after - 1] > SILENCE_S
    edges = np.diff(np.concatenate([[False], pair.own.gap | pair.peer.gap, [False]]).astype(int))
    for start, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
        if (end - start) * pair.dt_s > SILENCE_S:
            silent[start:end] = True
    if not silent.any():
        return []
    ends = np.flatnonzero(np.diff(np.concatenate([[True], silent, [True]]).astype(int)))
    parts = [(pair.time_s[a], pair.time_s[b - 1]) for a, b in ends.reshape(-1, 2)]
    made = [_cut(pair, a, b) for a, b in parts if b - a >= LEAST_S]
    return [part for part in made if len(part.range_m) >= LEAST_RANGES]


def joined(flight: Problem, parts: Sequence[Estimate]) -> Array:
    """Join solved segments to states (K, 6) of the whole flight, by dead reckoning in between.

    Parameters
    ----------
    flight
        Keyframes of the whole flight.
    parts
        Estimates of one segment or more, in order of time.
    """
    key_s, (heading, place), (turned, way) = flight.key_s, path_of(flight.own), path_of(flight.peer)
    ways = []
    for part in parts:
        at = np.flatnonzero((key_s >= part.time_s[0]) & (key_s <= part.time_s[-1]))
        columns = (*part.state[:, :2].T, np.unwrap(part.state[:, 2]))
        known = np.column_stack([np.interp(key_s[at], part.time_s, c) for c in columns])
        seen = rotate(rotation(heading[at]), known[:, :2]) + place[at]
        # Before and after the segment the peer follows its odometry, from either end.
        near = np.clip(np.arange(len(key_s)), at[0], at[-1]) - at[0]
        turn = (heading[at] + known[:, 2] - turned[at])[near]
        there = seen[near] + rotate(rotation(turn), way - way[at][near])
        ways.append((at[0], at[-1], np.column_stack([there, turn + turned - heading])))
    state = ways[0][2]
    for (_, last, _), (first, _, track) in pairwise(ways):
        track[:, 2] += 2 * np.pi * np.round((state[first, 2] - track[first, 2]) / (2 * np.pi))
        share = np.clip((np.arange(len(key_s)) - last) / (first - last), 0.0, 1.0)[:, None]
        state = (1 - share) * state + share * track
    xy = rotate(rotation(-heading), state[:, :2] - place)
    return np.column_stack([xy, state[:, 2], np.zeros((len(key_s), 2)), _errors(key_s, parts)])


def _errors(key_s: Array, parts: Sequence[Estimate]) -> Array:
    """Return (K,) range errors of the segments; 0 between them."""
    out = np.zeros(len(key_s))
    for part in parts:
        at = (key_s >= part.time_s[0]) & (key_s <= part.time_s[-1])
        if part.range_error_m is not None:
            out[at] = np.interp(key_s[at], part.time_s, part.range_error_m)
    return out


def mended(
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
        if contradicts(here, own) or contradicts(there, peer):
            here, there = _with(here, own), _with(there, peer)
    return here, there


def _with(whole: Estimate, part: Estimate) -> Estimate:
    """Return the estimate of the whole flight with one segment replaced."""
    at = (whole.time_s >= part.time_s[0]) & (whole.time_s <= part.time_s[-1])
    time_s = whole.time_s[at]
    near = np.clip(np.searchsorted(part.time_s, time_s), 0, len(part.time_s) - 1)
    columns = (*part.state[:, :2].T, np.unwrap(part.state[:, 2]))
    state, covariance, status = whole.state.copy(), whole.covariance.copy(), whole.status.copy()
    state[at] = np.column_stack([np.interp(time_s, part.time_s, column) for column in columns])
    covariance[at], status[at] = part.covariance[near], part.status[near]
    return replace(whole, state=state, covariance=covariance, status=status)


def _cut(pair: Pair, start_s: float, end_s: float) -> Pair:
    """Crop a pair to an interval."""
    at = (pair.time_s >= start_s) & (pair.time_s <= end_s)
    time_s = pair.time_s[at]
    inside = (pair.range_time_s >= time_s[0]) & (pair.range_time_s <= time_s[-1])
    own_sees, peer_sees = (
        within(seen, time_s[0], time_s[-1]) for seen in (pair.own_sees, pair.peer_sees)
    )
    return Pair(
        time_s,
        _cut_track(pair.own, at),
        _cut_track(pair.peer, at),
        pair.range_time_s[inside],
        pair.range_m[inside],
        own_sees,
        peer_sees,
        pair.known_std,
    )


def _cut_track(track: Track, at: Mask) -> Track:
    """Crop the signals of one robot."""
    vx, vy, yaw_rate, height = (signal[at] for signal in track.values())
    silent = None if track.height_gap is None else track.height_gap[at]
    return Track(vx, vy, yaw_rate, height, track.gap[at], silent)
