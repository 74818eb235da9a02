"""Robust EKF of a pair over keyframes, for many hypotheses, forwards and backwards in time.

The state is x, y, psi of the peer in the observer's horizontal frame and the biases of both yaw
rates. A lane is one run through the flight from a start in either direction; hypotheses of all
lanes run side by side.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.bearings import subtract_bearings
from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.keyframes import average_ranges
from dmrl.estimation.solver.problem import CameraView, Problem
from dmrl.estimation.solver.residuals import odometry_variance

SIZE = 5
"""Number of states."""
HYPOTHESIS_STD: Array = np.array([0.35, 0.35, 0.45, 0.01, 0.01])
"""Initial standard deviations of x, y (m), psi (rad): half the distance to the next hypothesis.
Then those of both yaw rate biases, rad/s."""
SHADOWED_RANGE_STD_M, RANGE_BIAS_STD_M = 0.3, 0.05
"""Standard deviations of a range after its step offset is removed, and of the unknown bias of an
averaged range, metres."""
SOFT_SIGMAS = 2.0
"""Innovation beyond which an update is down-weighted, in standard deviations."""
IMAGE_INTERVAL_S, IMAGE_STD, IMAGE_GATE = 0.4, 0.05, 16.0
"""Interval between used images of a camera, seconds; standard deviation added because an image is
beside its keyframe, radians; gate on the squared distance of a candidate, four sigmas."""


@dataclass(frozen=True, slots=True)
class Lane:
    """One run through a flight: T keyframes from a start.

    Parameters
    ----------
    keyframe
        (T,) keyframes in the order of the run.
    forwards
        Whether the run follows time.
    """

    keyframe: NDArray[np.intp]
    forwards: bool


@dataclass(frozen=True, slots=True)
class FilterInputs:
    """Measurements of a pair at K keyframes, and its motions.

    ``step_s`` (K - 1,), ``turns`` (K - 1, 2), ``shifts`` (K - 1, 2, 2) of observer and peer,
    ``step_var`` (K - 1, 5), ``range_m`` (K,) and ``range_var`` (K,), NaN without a range,
    ``height_m`` (K,), ``images`` by keyframe: (sign of the observer, bearing, std).
    """

    step_s: Array
    turns: Array
    shifts: Array
    step_var: Array
    range_m: Array
    range_var: Array
    height_m: Array
    images: dict[int, list[tuple[float, Array, Array]]]


class FilterPaths(NamedTuple):
    """Paths of B filters over T keyframes.

    ``state`` (T, B, 5) after the update, ``log_likelihood`` (T, B) of each keyframe's measurements.
    """

    state: Array
    log_likelihood: Array


class FilterRun(NamedTuple):
    """Run of B filters over T keyframes, or at one of them, with what smoothing needs.

    ``state``, ``log_likelihood`` as in `FilterPaths`, ``covariance`` (T, B, 5, 5) after the update,
    ``prior``, ``prior_covariance`` before, ``step`` (T, B, 5, 5) Jacobian from the keyframe before.
    """

    state: Array
    log_likelihood: Array
    covariance: Array
    prior: Array
    prior_covariance: Array
    step: Array


def build_inputs(problem: Problem, range_excess_m: float = 0.0) -> FilterInputs:
    """Build the filter inputs of a pair.

    Parameters
    ----------
    problem
        Flight of two robots.
    range_excess_m
        Assumed excess of all ranges, metres.
    """
    count = len(problem.keyframe_s)
    link = average_ranges(problem.links[0], problem.keyframe_s)
    range_m, variance = np.full(count, np.nan), np.full(count, np.nan)
    range_m[link.keyframe] = link.range_m - range_excess_m
    shadow = (link.offset_guess_m != 0) * SHADOWED_RANGE_STD_M**2
    noise = problem.noise
    variance[link.keyframe] = (
        (noise.range_std_m * link.std_share) ** 2 + RANGE_BIAS_STD_M**2 + shadow
    )
    one, other = problem.robots
    step_var = np.zeros((count - 1, SIZE))
    extra = problem.fading_psd * one.steps_s
    for robot in range(2):
        step_var[:, :3] += odometry_variance(problem, robot)
        step_var[:, :2] += extra[:, None]
    return FilterInputs(
        one.steps_s,
        np.column_stack([one.motion.turn_rad, other.motion.turn_rad]),
        np.stack([one.motion.shift_m, other.motion.shift_m], axis=1),
        step_var,
        range_m,
        variance,
        other.height_m - one.height_m,
        _select_images(problem.views),
    )


def _select_images(views: Sequence[CameraView]) -> dict[int, list[tuple[float, Array, Array]]]:
    """Return some images of both cameras, by keyframe."""
    out: dict[int, list[tuple[float, Array, Array]]] = {}
    for view in views:
        last_s, sign = -np.inf, 1.0 if view.robots[0] < view.robots[1] else -1.0
        for k in range(len(view.time_s)):
            if view.time_s[k] >= last_s + IMAGE_INTERVAL_S:
                last_s = view.time_s[k]
                there = np.isfinite(view.bearing[k, :, 0])
                bearing, std = view.bearing[k, there].copy(), view.std[k, there]
                bearing[:, 0] += view.own_turn_rad[k]
                seen = (sign, bearing, np.hypot(std, IMAGE_STD))
                out.setdefault(int(view.keyframe[k]), []).append(seen)
    return out


def run_lanes(
    inputs: FilterInputs, lanes: Sequence[Lane], start: Array, lane_of: NDArray[np.intp], steps: int
) -> FilterRun:
    """Run B filters side by side, each along its lane, for a number of keyframes at most.

    Parameters
    ----------
    inputs
        Measurements of the pair.
    lanes
        Runs through the flight.
    start
        (B, 3) first x, y, psi.
    lane_of
        (B,) index of each filter's lane.
    steps
        Largest number of keyframes. A lane that ends before waits.
    """
    count = min(steps, max(len(lane.keyframe) for lane in lanes))
    return FilterRun(*_stack(_iter_keyframes(inputs, lanes, start, lane_of, count), count))


def trace_lanes(
    inputs: FilterInputs, lanes: Sequence[Lane], start: Array, lane_of: NDArray[np.intp], steps: int
) -> FilterPaths:
    """Run filters as `run_lanes` does, without the memory that smoothing takes."""
    count = min(steps, max(len(lane.keyframe) for lane in lanes))
    every = _iter_keyframes(inputs, lanes, start, lane_of, count)
    return FilterPaths(*_stack(((one.state, one.log_likelihood) for one in every), count))


def _stack(rows: Iterable[Sequence[Array]], count: int) -> list[Array]:
    """Stack the arrays (..., B) of a number of rows to (T, B, ...), and hold one row at a time."""
    out: list[Array] = []
    for t, row in enumerate(rows):
        out = out or [np.empty((count, *array.shape)) for array in row]
        for stacked, array in zip(out, row, strict=True):
            stacked[t] = array
    return [np.moveaxis(stacked, -1, 1) for stacked in out]


def _iter_keyframes(
    inputs: FilterInputs, lanes: Sequence[Lane], start: Array, lane_of: NDArray[np.intp], count: int
) -> Iterator[FilterRun]:
    """Yield the filters at each of a number of keyframes: arrays without the axis of time.

    Filters are last in memory: an operation on all of them is faster than one on small matrices.
    """
    state, step = np.zeros((SIZE, len(start))), np.zeros((SIZE, SIZE, len(start)))
    state[:3], covariance = start.T, np.zeros_like(step)
    covariance[range(SIZE), range(SIZE)] = (HYPOTHESIS_STD**2)[:, None]
    keys = np.stack([_pad_with_none(lane.keyframe, count) for lane in lanes])
    motions, ranges = _list_motions(inputs, keys), _list_ranges(inputs, keys)
    columns = [np.flatnonzero(lane_of == number) for number in range(len(lanes))]
    for t in range(count):
        if t > 0:
            motion = motions[t - 1].take(lane_of, axis=1)
            state, covariance, step = _propagate(state, covariance, motion)
        prior = state.copy(), covariance.copy()
        filters = FilterRun(state, np.zeros(len(start)), covariance, *prior, step)
        _update_ranges(filters, ranges[t].take(lane_of, axis=1))
        for key, mine in zip(keys[:, t].tolist(), columns, strict=True):
            for image in inputs.images.get(key, ()):
                _update_image(filters, mine, image, float(inputs.height_m[key]))
        yield filters


def _pad_with_none(keyframe: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    return np.concatenate([keyframe[:count], np.full(max(count - len(keyframe), 0), -1)])


def _list_motions(inputs: FilterInputs, keys: NDArray[np.intp]) -> Array:
    """Return (T - 1, 12, L) motions of lanes from each keyframe to the next; 0 after their ends.

    They are seconds, negative backwards; turns of observer and peer; shifts of both; variances.
    Backwards a step is its inverse: the turn negated, the shift seen from its end. ``keys`` (L, T)
    are the keyframes, -1 after the end of a lane.
    """
    before, after = keys[:, :-1], keys[:, 1:]
    moving = after >= 0
    step = np.where(moving, np.minimum(before, after), 0)
    sign = np.where(after > before, 1.0, -1.0) * moving
    turns = inputs.turns[step]
    seen_from = np.where((sign < 0)[..., None], -turns, 0.0)
    shifts = rotate(rotation_matrix(seen_from), inputs.shifts[step])
    every = [
        (sign * inputs.step_s[step])[..., None],
        sign[..., None] * turns,
        sign[..., None] * shifts.reshape(*sign.shape, 4),
        inputs.step_var[step] * moving[..., None],
    ]
    return np.ascontiguousarray(np.concatenate(every, axis=-1).transpose(1, 2, 0))


def _list_ranges(inputs: FilterInputs, keys: NDArray[np.intp]) -> Array:
    """Return (T, 4, L) ranges of lanes: whether there is one, range, variance, squared height."""
    key = np.maximum(keys, 0)
    seen = (keys >= 0) & np.isfinite(inputs.range_m[key])
    measured = np.where(seen, inputs.range_m[key], 0.0)
    variance = np.where(seen, inputs.range_var[key], 1.0)
    every = np.stack([seen, measured, variance, inputs.height_m[key] ** 2])
    return np.ascontiguousarray(every.transpose(2, 0, 1))


def _propagate(state: Array, covariance: Array, motion: Array) -> tuple[Array, Array, Array]:
    """Return states (5, B), covariances and Jacobians (5, 5, B) at the next keyframe of each lane.

    ``motion`` (12, B) as in `_list_motions`.
    """
    seconds, shift, peer = motion[0], motion[3:5], motion[5:7]
    turn, peer_turn = motion[1:3] - seconds * state[3:]
    cos, sin = np.cos(state[2]), np.sin(state[2])
    x, y = cos * peer[0] - sin * peer[1], sin * peer[0] + cos * peer[1]
    far_x, far_y = state[0] + x - shift[0], state[1] + y - shift[1]
    cos, sin = np.cos(turn), np.sin(turn)
    out, step = state.copy(), np.zeros_like(covariance)
    out[0], out[1] = cos * far_x + sin * far_y, cos * far_y - sin * far_x
    out[2] += peer_turn - turn
    step[0, 0] = step[1, 1] = cos
    step[0, 1], step[1, 0] = sin, -sin
    step[0, 2], step[1, 2] = sin * x - cos * y, sin * y + cos * x
    step[0, 3], step[1, 3] = -seconds * out[1], seconds * out[0]
    step[[2, 3, 4], [2, 3, 4]] = 1.0
    step[2, 3], step[2, 4] = seconds, -seconds
    # Only x, y and psi move, and x and y do not depend on the peer's bias.
    moved = covariance.copy()
    moved[:2] = np.einsum("ikb,kjb->ijb", step[:2, :4], covariance[:4])
    moved[2] += seconds * (covariance[3] - covariance[4])
    spread = moved.copy()
    spread[:, :2] = np.einsum("ikb,jkb->ijb", moved[:, :4], step[:2, :4])
    spread[:, 2] += seconds * (moved[:, 3] - moved[:, 4])
    np.einsum("iib->ib", spread)[...] += motion[7:]
    return out, spread, step


def _update_ranges(filters: FilterRun, ranges: Array) -> None:
    """Update filters with the ranges (4, B) of their keyframes (`_list_ranges`), in place."""
    state, log_likelihood, covariance = filters[:3]
    seen, measured, variance, height2 = ranges
    expected = np.sqrt(state[0] * state[0] + state[1] * state[1] + height2) + 1e-6
    x, y = state[:2] / expected
    cross = covariance[:, 0] * x + covariance[:, 1] * y
    spread = x * cross[0] + y * cross[1] + variance
    innovation = seen * (measured - expected)
    size = np.abs(innovation) / np.sqrt(spread)
    log_likelihood -= seen * (0.5 * np.log(spread) + np.log1p(0.5 * size**2))
    # A large innovation counts as a noisy range.
    spread += variance * (np.maximum(1.0, size / SOFT_SIGMAS) ** 2 - 1)
    gain = seen / spread * cross
    state += gain * innovation
    covariance -= gain[:, None] * cross


def _update_image(
    filters: FilterRun,
    mine: NDArray[np.intp],
    image: tuple[float, Array, Array],
    height_m: float,
) -> None:
    """Update some filters with the candidate nearest to each, in place. The azimuth alone counts.

    A filter far from every candidate stays as it is.
    """
    state, log_likelihood, covariance = filters[:3]
    sign, bearing, std = image
    x, y = sign * state[:2, mine]
    up = sign * height_m
    level2 = np.maximum(x * x + y * y, 1e-4)
    turned = sign < 0
    azimuth = np.arctan2(y, x) - turned * state[2, mine]
    elevation, log_distance = np.arctan2(up, np.sqrt(level2)), np.log(level2 + up * up) / 2
    polar = np.column_stack([azimuth, elevation, log_distance])
    row = np.stack([-y, x, np.zeros(len(x))]) * (sign / level2)
    row[2] = -1.0 * turned
    farther = np.stack([x, y]) * (sign / (level2 + up * up))
    part = covariance[:, :, mine]
    cross = np.einsum("ijb,jb->ib", part[:, :3], row)
    spread = np.zeros((len(mine), 1, 3))
    spread[:, 0, 0] = np.einsum("ib,ib->b", row, cross[:3])
    spread[:, 0, 2] = np.einsum("ib,ijb,jb->b", farther, part[:2, :2], farther)
    spread = spread + std**2
    off = subtract_bearings(bearing, polar[:, None])
    squared = (off**2 / spread).sum(axis=2)
    nearest, each = squared.argmin(axis=1), np.arange(len(mine))
    least, variance = squared[each, nearest], spread[each, nearest, 0]
    log_likelihood[mine] -= 0.5 * np.log(variance) + np.log1p(0.5 * least)
    gain = np.where(least < IMAGE_GATE, 1 / variance, 0.0) * cross
    state[:, mine] += gain * off[each, nearest, 0]
    covariance[:, :, mine] -= gain[:, None] * cross


def smooth_rts(run: FilterRun) -> Array:
    """Return (T, B, 5) states smoothed from the end of each lane to its start."""
    state = run.state.copy()
    for t in range(len(state) - 2, -1, -1):
        back = np.linalg.solve(
            run.prior_covariance[t + 1], (state[t + 1] - run.prior[t + 1])[..., None]
        )
        pulled = np.einsum("bki,bk->bi", run.step[t + 1], back[..., 0])
        state[t] += np.einsum("bik,bk->bi", run.covariance[t], pulled)
    return state
