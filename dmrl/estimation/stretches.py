"""A flight whose ranges were silent for long, stretch by stretch.

Through a silence of half a minute dead reckoning is off by a metre, and what comes after may fit
a wrong side of the observer as well as the right one. So every stretch with ranges is solved by
itself too. Where a stretch alone is sure and the whole flight contradicts it, the stretch counts.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from dmrl.estimation.gate import OK
from dmrl.estimation.pair import Mask, Pair, Track

if TYPE_CHECKING:
    from dmrl.estimation.estimate import Estimate

SILENCE_S = 5.0
"""Ranges that are silent for so long part a flight."""
LEAST_S = 10.0
"""Shorter stretches tell nothing by themselves."""
INSIDE, CONTRADICTED = 0.99, 0.2
"""A solution is not believed where more than this share of another's sure positions lie outside
that one's 99 % ellipse."""


def contradicts(whole: "Estimate", sure: "Estimate") -> bool:
    """Whether one solution lies where another, where it was sure, says that nobody was.

    Parameters
    ----------
    whole
        The solution that is doubted.
    sure
        Another solution of the same ordered pair, of the same time or a part of it.
    """
    xy, _, _ = whole.at(sure.time_s)
    known = sure.status == OK
    if not known.any():
        return False
    apart = (xy - sure.state[:, :2])[known]
    information = np.linalg.inv(sure.covariance[known, :2, :2])
    squared = np.einsum("ki,kij,kj->k", apart, information, apart)
    return bool((squared > chi2.ppf(INSIDE, 2)).mean() > CONTRADICTED)


def stretches(pair: Pair) -> list[Pair]:
    """The parts of a flight between long silences of its ranges; none where there is no such one.

    Parameters
    ----------
    pair
        What both measured.
    """
    edges = np.flatnonzero(np.diff(pair.range_time_s) > SILENCE_S)
    if not len(edges):
        return []
    starts = np.concatenate([[pair.time_s[0]], pair.range_time_s[edges + 1]])
    ends = np.concatenate([pair.range_time_s[edges], [pair.time_s[-1]]])
    return [_cut(pair, a, b) for a, b in zip(starts, ends, strict=True) if b - a >= LEAST_S]


def mended(
    pair: Pair,
    both: "tuple[Estimate, Estimate]",
    solve: "Callable[[list[Pair]], list[tuple[Estimate, Estimate]]]",
) -> "tuple[Estimate, Estimate]":
    """Both directions of a pair, with the stretches that are surer alone.

    Parameters
    ----------
    pair, both
        What was measured, and the solution of the whole flight.
    solve
        How pairs are solved.
    """
    here, there = both
    parts = stretches(pair)
    for own, peer in solve(parts) if parts else ():
        if contradicts(here, own) or contradicts(there, peer):
            here, there = _with(here, own), _with(there, peer)
    return here, there


def _with(whole: "Estimate", part: "Estimate") -> "Estimate":
    """The whole flight's solution with that of a part of it."""
    at = (whole.time_s >= part.time_s[0]) & (whole.time_s <= part.time_s[-1])
    time_s = whole.time_s[at]
    near = np.clip(np.searchsorted(part.time_s, time_s), 0, len(part.time_s) - 1)
    columns = (*part.state[:, :2].T, np.unwrap(part.state[:, 2]))
    state, covariance, status = whole.state.copy(), whole.covariance.copy(), whole.status.copy()
    state[at] = np.column_stack([np.interp(time_s, part.time_s, column) for column in columns])
    covariance[at], status[at] = part.covariance[near], part.status[near]
    return replace(whole, state=state, covariance=covariance, status=status)


def _cut(pair: Pair, start_s: float, end_s: float) -> Pair:
    at = (pair.time_s >= start_s) & (pair.time_s <= end_s)
    time_s = pair.time_s[at]
    inside = (pair.range_time_s >= time_s[0]) & (pair.range_time_s <= time_s[-1])
    return Pair(
        time_s,
        _cut_track(pair.own, at),
        _cut_track(pair.peer, at),
        pair.range_time_s[inside],
        pair.range_m[inside],
    )


def _cut_track(track: Track, at: Mask) -> Track:
    vx, vy, yaw_rate, height = (signal[at] for signal in track.values())
    silent = None if track.height_gap is None else track.height_gap[at]
    return Track(vx, vy, yaw_rate, height, track.gap[at], silent)
