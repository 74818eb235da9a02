"""Hypotheses of a pair on the range circle, followed from several starts in the flight."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import Array
from dmrl.estimation.search.pair_filter import (
    FilterInputs,
    Lane,
    build_inputs,
    run_lanes,
    smooth_rts,
    trace_lanes,
)
from dmrl.estimation.solver.problem import Problem

BEARING_COUNT, HEADING_COUNT = 12, 8
"""Number of bearings of the peer, and of headings for each bearing: 96 hypotheses. Their distance
is two initial standard deviations of the filter."""
START_INTERVAL_S, MAX_STARTS = 25.0, 4
"""Interval between starts, seconds, and their largest number. A filter forgets a wrong start in
some 20 s of motion, so one of them mostly finds the right mode."""
SCORING_S = 20.0
"""Time over which all hypotheses of a start are followed, seconds, in either direction."""
KEPT_HYPOTHESES = 6
"""Number of hypotheses of a start that are followed to both ends of the flight."""
DISTINCT_M, DISTINCT_RAD = 0.4, 0.5
"""Hypotheses closer than both are the same, metres and radians: one step of the circle at 0.8 m."""


@dataclass(frozen=True, slots=True)
class Track:
    """Hypothesis followed over a flight of K keyframes.

    Parameters
    ----------
    pose
        (K, 3) x, y (m), psi (rad) of the peer.
    gyro_bias_radps
        (2,) biases of both yaw rates.
    log_likelihood
        (K,) of the measurements of each keyframe.
    range_excess_m
        Assumed excess of all ranges, metres.
    """

    pose: Array
    gyro_bias_radps: Array
    log_likelihood: Array
    range_excess_m: float = 0.0

    @property
    def score(self) -> float:
        """Log likelihood of the flight."""
        return float(self.log_likelihood.sum())


def range_circle(range_m: float, height_m: float) -> Array:
    """Return (96, 3) hypotheses x, y (m), psi (rad) of the peer around an observer."""
    radius = np.sqrt(max(range_m**2 - height_m**2, 0.05**2))
    bearing = np.repeat(np.arange(BEARING_COUNT), HEADING_COUNT) * 2 * np.pi / BEARING_COUNT
    heading = np.tile(np.arange(HEADING_COUNT), BEARING_COUNT) * 2 * np.pi / HEADING_COUNT
    # The headings of neighbouring bearings are half a step apart, which fills the space better.
    heading += np.repeat(np.arange(BEARING_COUNT) % 2, HEADING_COUNT) * np.pi / HEADING_COUNT
    return np.column_stack([radius * np.cos(bearing), radius * np.sin(bearing), heading])


def choose_starts(key_s: Array) -> NDArray[np.intp]:
    """Return the keyframes at which hypotheses start: the first one, and others in mid-flight."""
    length_s = float(key_s[-1] - key_s[0])
    count = int(np.clip(length_s / START_INTERVAL_S, 1, MAX_STARTS))
    return np.asarray(np.searchsorted(key_s, key_s[0] + np.arange(count) * length_s / count))


def follow_hypotheses(problem: Problem, range_excess_m: float = 0.0) -> list[Track]:
    """Follow the likely hypotheses of every start forwards and backwards, best first.

    Parameters
    ----------
    problem
        Flight of two robots.
    range_excess_m
        Assumed excess of all ranges, metres.
    """
    inputs, key_s = build_inputs(problem, range_excess_m), problem.keyframe_s
    starts, last = choose_starts(key_s), len(key_s) - 1
    lanes, start_of = [], []
    for number, start in enumerate(starts.tolist()):
        ways = [Lane(np.arange(start, last + 1), True)]
        if start > 0:
            ways.append(Lane(np.arange(start, -1, -1), False))
        lanes += ways
        start_of += [number] * len(ways)
    circles = [_circle_at(inputs, start) for start in starts.tolist()]
    few = int(np.searchsorted(key_s, key_s[0] + SCORING_S))
    chosen = _select_hypotheses(inputs, lanes, start_of, circles, max(few, 2))
    lane_of = np.repeat(np.arange(len(lanes)), KEPT_HYPOTHESES)
    begun = np.concatenate([circles[s][chosen[s]] for s in start_of])
    run = run_lanes(inputs, lanes, begun, lane_of, last + 1)
    smooth = smooth_rts(run)
    tracks = []
    for number in range(len(starts)):
        for k in range(KEPT_HYPOTHESES):
            columns = [lane * KEPT_HYPOTHESES + k for lane, s in enumerate(start_of) if s == number]
            tracks.append(_glue(lanes, columns, smooth, run.log_likelihood, range_excess_m))
    return sorted(tracks, key=lambda track: -track.score)


def _circle_at(inputs: FilterInputs, start: int) -> Array:
    """Return the hypotheses at a start, from the median of the next ranges."""
    seen = start + np.flatnonzero(np.isfinite(inputs.range_m[start:]))
    if not len(seen):
        seen = np.flatnonzero(np.isfinite(inputs.range_m))[-1:]
    if not len(seen):
        # Without ranges a detection gives the distance.
        later = [key for key in sorted(inputs.images) if key >= start] or sorted(inputs.images)[-1:]
        distances = [np.exp(b[:, 2]) for key in later[:5] for _, b, _ in inputs.images[key]]
        found = np.concatenate(distances) if distances else np.ones(1)
        return range_circle(float(np.median(found)), 0.0)
    # A single range may be an outlier.
    range_m = float(np.median(inputs.range_m[seen[:5]]))
    return range_circle(range_m, float(inputs.height_m[seen[0]]))


def _select_hypotheses(
    inputs: FilterInputs, lanes: list[Lane], start_of: list[int], circles: list[Array], steps: int
) -> list[list[int]]:
    """Return the likely and distinct hypotheses of each start."""
    count = BEARING_COUNT * HEADING_COUNT
    begun = np.concatenate([circles[s] for s in start_of])
    lane_of = np.repeat(np.arange(len(lanes)), count)
    paths = trace_lanes(inputs, lanes, begun, lane_of, steps)
    score = paths.log_likelihood.sum(axis=0).reshape(len(lanes), count)
    ends = np.stack(
        [
            paths.state[min(steps, len(lane.keyframe)) - 1, k * count : (k + 1) * count, :3]
            for k, lane in enumerate(lanes)
        ]
    )
    out = []
    for number in range(len(circles)):
        mine = [k for k, s in enumerate(start_of) if s == number]
        order = np.argsort(-score[mine].sum(axis=0))
        out.append(select_distinct_states(ends[mine], order, KEPT_HYPOTHESES))
    return out


def select_distinct_states(states: Array, order: NDArray[np.intp], count: int) -> list[int]:
    """Return the indices of ``count`` distinct hypotheses, in order. The last one fills up.

    Parameters
    ----------
    states
        (L, N, 3) x, y, psi of N hypotheses at the ends of L lanes.
    order
        (N,) their indices, best first.
    count
        Number of indices to return.
    """
    kept: list[int] = []
    for number in order.tolist():
        apart = states[:, kept] - states[:, number, None]
        turn = np.abs(np.angle(np.exp(1j * apart[..., 2])))
        same = (np.hypot(apart[..., 0], apart[..., 1]) < DISTINCT_M) & (turn < DISTINCT_RAD)
        if not same.all(axis=0).any():
            kept.append(number)
        if len(kept) == count:
            break
    return kept + kept[-1:] * (count - len(kept))


def _glue(
    lanes: list[Lane], columns: list[int], smooth: Array, likelihood: Array, excess_m: float
) -> Track:
    """Join the lanes of one hypothesis to a track of the whole flight."""
    last = max(int(lanes[c // KEPT_HYPOTHESES].keyframe.max()) for c in columns)
    pose, score, bias = np.zeros((last + 1, 3)), np.zeros(last + 1), np.zeros(2)
    for c in reversed(columns):  # the forward lane last: it contains the start
        key = lanes[c // KEPT_HYPOTHESES].keyframe
        pose[key], score[key] = smooth[: len(key), c, :3], likelihood[: len(key), c]
        bias += smooth[0, c, 3:] / len(columns)
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Track(pose, bias, score, excess_m)
