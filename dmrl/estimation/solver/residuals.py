"""Factors of a flight: residuals with Jacobians of odometry, ranges, bearings, and priors.

Every factor is linearized to rows. A row group contains the Jacobians by a keyframe (and by the
next one), by the constants, and the residual, whitened. `Rows` and `Chain` add themselves to the
normal equations and return their loss, so a new factor is one function that returns one of them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.bearings import subtract_bearings
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import NormalEquations
from dmrl.estimation.solver.layout import Layout
from dmrl.estimation.solver.problem import CameraView, PaddedRanges, Problem, RangeLink
from dmrl.estimation.solver.robust_loss import Loss

MAX_OUTLIER_SIGMAS, AZIMUTH_MARGIN_RAD = 5.0, 0.05
"""Distance beyond which an image has no weight, in sigmas; and the azimuth error of an unfinished
solve that is added, radians. Wrong detections bent flights that a camera rarely covers."""


class Values(NamedTuple):
    """Values of all unknowns: (K, n) of the keyframes, and (G,) constants."""

    state: Array
    constants: Array


class Factor(Protocol):
    """Linearized factor."""

    def cost(self) -> float:
        """Return half the sum of the losses."""

    def add_to(self, equations: NormalEquations) -> None:
        """Add the weighted rows to the normal equations."""


@dataclass(frozen=True)
class Rows:
    """Whitened rows of one kind of measurement.

    Parameters
    ----------
    rows
        (B, m, q, w) of every keyframe, or of every step: m measurements of q values each. The last
        column is the residual.
    columns, border
        Columns of the keyframe and of the constants, in the order of the rows.
    loss
        Loss of the squared length of the q values.
    weight
        (B, m) factor of the loss; 0 pads keyframes with fewer measurements.
    steps
        Whether the rows depend on the next keyframe too.
    """

    rows: Array
    columns: list[int]
    border: list[int]
    loss: Loss
    weight: Array
    steps: bool = False

    @cached_property
    def square(self) -> Array:
        """(B, m) squared whitened residuals."""
        return np.asarray((self.rows[..., -1] ** 2).sum(axis=-1))

    def cost(self) -> float:
        """Return half the sum of the losses."""
        return float((self.weight * self.loss.cost(self.square)).sum()) / 2

    def add_to(self, equations: NormalEquations) -> None:
        """Add the weighted rows to the normal equations."""
        root = np.sqrt(self.weight * self.loss.weight(self.square))
        flat = (self.rows * root[..., None, None]).reshape(len(self.rows), -1, self.rows.shape[-1])
        equations.add_rows(flat, self.columns, self.border, self.steps)

    def with_residuals_of(self, other: "Rows") -> "Rows":
        """Return the rows with the residuals, and so the weights, of another linearization."""
        rows = self.rows.copy()
        rows[..., -1] = other.rows[..., -1]
        return Rows(rows, self.columns, self.border, self.loss, other.weight, self.steps)


def odometry_variance(problem: Problem, robot: int) -> Array:
    """Return (S, 3) variances of the measured motions between keyframes."""
    steps, noise = problem.robots[robot], problem.noise
    shift = (
        noise.velocity_psd * (noise.grade * steps.noise_factor * steps.grade) ** 2 * steps.steps_s
    )
    shift = shift + noise.dropout_speed_mps**2 * steps.dropout_s
    turn = noise.yaw_rate_psd * steps.steps_s + noise.dropout_turn_radps**2 * steps.turn_dropout_s
    return np.stack([shift, shift, turn]).T


def motion_gain(layout: Layout, robot: int, constants: Array) -> Array:
    """Return (2,) measured shift of a robot over its true shift, along x and y."""
    gain = np.ones(2)
    for row, c, constant in layout.of(robot):
        if row.motion_scale and constant:
            gain = gain + np.array(row.motion_scale) * constants[c]
    return np.asarray(np.maximum(gain, 0.1))


def odometry_factor(problem: Problem, layout: Layout, robot: int, values: Values) -> Rows:
    """Linearize the measured motions of one robot: predicted minus measured shift and turn."""
    steps, pose = problem.robots[robot], values.state[:, layout.pose(robot)].T
    cos, sin = np.cos(pose[2, :-1]), np.sin(pose[2, :-1])
    moved = np.diff(pose)
    way = np.stack([cos * moved[0] + sin * moved[1], cos * moved[1] - sin * moved[0]])
    mine = list(layout.of(robot))
    columns = layout.pose(robot) + [c for row, c, constant in mine if row.motion and not constant]
    border = [c for row, c, constant in mine if constant and (row.motion or row.motion_scale)]
    size = len(columns)
    # Steps are last in memory, as `NormalEquations.add_rows` adds them.
    out = np.zeros((2 * size + len(border) + 1, 3, len(cos)))
    gain = motion_gain(layout, robot, values.constants)
    for row, c, constant in mine:
        if row.motion_scale and constant:
            out[2 * size + border.index(c), :2] += way * np.array(row.motion_scale)[:, None]
        if row.motion and constant:
            effect = steps.effect_of(row.motion)
            out[2 * size + border.index(c)] += effect
            out[-1] += effect * values.constants[c]
        elif row.motion:
            # A state acts by the mean of its values at both ends.
            effect, at = steps.effect_of(row.motion) / 2, columns.index(c)
            out[at] = out[size + at] = effect
            out[-1] += effect * (values.state[:-1, c] + values.state[1:, c])
    out[-1, :2] += gain[:, None] * way - steps.motion.shift_m.T
    out[-1, 2] += moved[2] - steps.motion.turn_rad
    out[size, :2] = gain[0] * cos, -gain[1] * sin
    out[size + 1, :2] = gain[0] * sin, gain[1] * cos
    out[:2, :2] = -out[size : size + 2, :2]
    out[2, :2] = gain[0] * way[1], -gain[1] * way[0]
    out[2, 2], out[size + 2, 2] = -1.0, 1.0
    out /= np.sqrt(odometry_variance(problem, robot)).T
    rows, ones = out.T[:, :, None], np.ones((3, len(cos))).T
    return Rows(rows, columns, border, problem.noise.motion_loss, ones, steps=True)


class _Geometry(NamedTuple):
    """Relative position of two robots at N measurements, and its derivatives.

    ``offset`` (N, 2) in the frame of the flight, ``up`` (N,) height difference, ``by_turn`` (N, 2)
    and (N, 2) derivatives of the offset by either heading, ``by_scale`` (N, 2) those by constants
    that scale a robot's motion.
    """

    offset: Array
    up: Array
    by_own_turn: Array
    by_peer_turn: Array
    by_scale: dict[int, Array]


def _geometry(measured: PaddedRanges | CameraView, layout: Layout, values: Values) -> _Geometry:
    """Return the relative position at each measurement."""
    here, there = (values.state[:, layout.pose(k)] for k in measured.robots)
    at = measured.keyframe
    own, by_own_scale = _correct_shift(measured, 0, layout, values)
    peer, by_scale = _correct_shift(measured, 1, layout, values)
    for c, effect in by_own_scale.items():
        by_scale[c] = by_scale.get(c, 0.0) - effect
    up = measured.height_m.copy()
    for row, c, constant, side in layout.measured(measured.robots, "height"):
        error = values.constants[c] if constant else values.state[at, c]
        up = up + side * row.height * error
    offset = np.take((there - here)[:, :2].T, at, axis=1).T + peer - own
    by_turn = np.stack([own[:, 1], -own[:, 0]]).T, np.stack([-peer[:, 1], peer[:, 0]]).T
    return _Geometry(offset, up, *by_turn, by_scale)


def _correct_shift(
    measured: PaddedRanges | CameraView, side: int, layout: Layout, values: Values
) -> tuple[Array, dict[int, Array]]:
    """Return a robot's motion from the keyframe to each measurement, in the frame of the flight.

    A scale of the measured motion counts between keyframes too: without it, many ranges show the
    error of those few centimetres. Its (N, 2) derivatives are returned by constant.
    """
    robot, shift = measured.robots[side], (measured.own_shift_m, measured.peer_shift_m)[side]
    heading = values.state[:, layout.pose(robot)[2]]
    cos, sin = (part.take(measured.keyframe) for part in (np.cos(heading), np.sin(heading)))
    # Axes are contiguous: half of the time of interleaved ones.
    ahead, aside = shift.T
    turned = np.stack([cos * ahead, sin * ahead]), np.stack([-sin * aside, cos * aside])
    gain = motion_gain(layout, robot, values.constants)

    def scale(factor: Array) -> Array:
        return np.asarray(turned[0] * factor[0] + turned[1] * factor[1]).T

    by_scale = {
        c: scale(-np.array(row.motion_scale) / gain**2)
        for row, c, constant in layout.of(robot)
        if row.motion_scale and constant and shift.any()
    }
    return scale(1 / gain), by_scale


def range_factor(problem: Problem, layout: Layout, link: RangeLink, values: Values) -> Rows:
    """Linearize the ranges of one pair: predicted minus measured."""
    padded, keyframes = link.pad(len(values.state)), len(values.state)
    at = _geometry(padded, layout, values)
    distance = np.sqrt(_dot(at.offset, at.offset) + at.up**2) + 1e-6
    towards = at.offset / distance[:, None]
    used = layout.measured(link.robots, "range")
    states = [c for _, c, constant, _ in used if not constant]
    border = [*(c for _, c, constant, _ in used if constant), *at.by_scale]
    columns = layout.pose(link.robots[0]) + layout.pose(link.robots[1]) + states
    # Keyframes are last in memory, as `NormalEquations.add_rows` adds them.
    out = np.zeros((len(columns) + len(border) + 1, len(distance)))
    predicted, gain, heights = distance - padded.range_m, np.ones_like(distance), []
    headings = (values.state[:, layout.pose(k)[2]].take(link.keyframe) for k in link.robots)
    offset = at.offset.T.take(padded.at, axis=1).T
    sights = link.list_sights(distance.take(padded.at), offset, *headings)
    for row, c, constant, side in used:
        column = len(columns) + border.index(c) if constant else columns.index(c)
        value = values.constants[c] if constant else values.state[padded.keyframe, c]
        if row.height:
            heights.append((column, side * row.height))
        elif row.range_power:
            out[column] = distance**row.range_power
            gain += row.range_power * value * distance ** (row.range_power - 1)
        elif row.range:
            out[column, padded.at] = row.range(link, sights[side])
        predicted += out[column] * value
    for column, share in heights:
        out[column] = (share * gain) * at.up / distance
    towards *= gain[:, None]
    for c, effect in at.by_scale.items():
        out[len(columns) + border.index(c)] = _dot(towards, effect)
    out[0:2], out[3:5] = -towards.T, towards.T
    for column, by_turn in ((2, at.by_own_turn), (5, at.by_peer_turn)):
        out[column] = _dot(towards, by_turn)
    out[-1] = predicted
    out *= padded.weight.ravel() / (problem.noise.range_std_m * padded.std_share)
    rows = out.reshape(len(out), 1, -1, keyframes).T
    return Rows(rows, columns, border, problem.noise.range_loss, padded.weight.T)


def _dot(one: Array, other: Array) -> Array:
    """Return (N,) scalar products of (N, 2) vectors."""
    return one[:, 0] * other[:, 0] + one[:, 1] * other[:, 1]


def bearing_factor(problem: Problem, layout: Layout, view: CameraView, values: Values) -> Rows:
    """Linearize the candidate of each image that is nearest to the present solution."""
    at, one = _geometry(view, layout, values), layout.pose(view.robots[0])
    used = layout.measured(view.robots, "bearing")
    states = [c for _, c, constant, _ in used if not constant]
    border = [*(c for _, c, constant, _ in used if constant), *at.by_scale]
    columns = one + layout.pose(view.robots[1]) + states
    polar, by_offset = _to_polar(at)
    polar[:, 0] -= values.state[view.keyframe, one[2]] + view.own_turn_rad
    out = np.zeros((len(polar), 3, len(columns) + len(border) + 1))
    out[..., 0:2], out[..., 3:5] = -by_offset[..., :2], by_offset[..., :2]
    out[..., 2] = rotate_rows(by_offset, at.by_own_turn)
    out[..., 5] = rotate_rows(by_offset, at.by_peer_turn)
    out[:, 0, 2] -= 1.0
    for c, effect in at.by_scale.items():
        out[..., len(columns) + border.index(c)] = rotate_rows(by_offset, effect)
    for row, c, constant, side in used:
        column = len(columns) + border.index(c) if constant else columns.index(c)
        if row.height:
            out[..., column] = side * row.height * by_offset[..., 2]
        elif row.bearing:
            effect = row.bearing(view)
            out[..., column] = effect
            value = values.constants[c] if constant else values.state[view.keyframe, c][:, None]
            polar = polar + effect * value
    _set_nearest(out, view, polar)
    return _pad_rows(
        out, view.keyframe, view.weight, len(values.state),
        (columns, border, problem.noise.bearing_loss),
    )  # fmt: skip


def _to_polar(at: _Geometry) -> tuple[Array, Array]:
    """Return (N, 3) azimuths in the flight's frame, elevations and log distances of offsets.

    Also (N, 3, 3) their derivatives by the offset.
    """
    x, y = at.offset.T
    level2 = np.maximum(x * x + y * y, 1e-6)
    square, level = level2 + at.up**2, np.sqrt(level2)
    polar = np.column_stack([np.arctan2(y, x), np.arctan2(at.up, level), np.log(square) / 2])
    out = np.zeros((len(x), 3, 3))
    out[:, 0, 0], out[:, 0, 1] = -y / level2, x / level2
    out[:, 1, :2] = -at.offset * (at.up / (level * square))[:, None]
    out[:, 1, 2] = level / square
    out[:, 2, :2], out[:, 2, 2] = at.offset / square[:, None], at.up / square
    return polar, out


def _set_nearest(rows: Array, view: CameraView, polar: Array) -> None:
    """Whiten (N, 3, w) rows by the candidate nearest to each prediction, and set its residual.

    Parameters
    ----------
    rows
        Derivatives; changed in place.
    view
        Images with candidates.
    polar
        (N, 3) predicted azimuth, elevation and log distance.
    """
    off = -subtract_bearings(view.bearing, polar[:, None]) / view.std
    squared = np.where(np.isnan(off).any(axis=-1), np.inf, (off**2).sum(axis=-1))
    nearest, images = squared.argmin(axis=1), np.arange(len(polar))
    std = view.std[images, nearest]
    rows[..., -1] = off[images, nearest]
    rows[..., :-1] /= std[..., None]
    spread = 1 + (AZIMUTH_MARGIN_RAD / std[:, 0]) ** 2
    lost = squared.min(axis=1) > MAX_OUTLIER_SIGMAS**2 * spread
    # A lost image costs the same wherever it is.
    rows[lost], rows[lost, 0, -1] = 0.0, MAX_OUTLIER_SIGMAS * np.sqrt(spread)[lost]


def rotate_rows(by_offset: Array, by_turn: Array) -> Array:
    """Return (N, 3) derivatives of a bearing by a heading that moves the offset."""
    return np.asarray((by_offset[..., :2] @ by_turn[..., None])[..., 0])


def _pad_rows(
    rows: Array,
    keyframe: NDArray[np.intp],
    weight: Array,
    keyframes: int,
    rest: tuple[list[int], list[int], Loss],
) -> Rows:
    """Return rows (N, q, w) of sorted keyframes as (K, m, q, w), padded with weight 0."""
    count = np.bincount(keyframe, minlength=keyframes)
    slot = np.arange(len(rows)) - (np.cumsum(count) - count)[keyframe]
    most = max(int(count.max(initial=0)), 1)
    # Keyframes are last in memory, as `NormalEquations.add_rows` adds them.
    out, factor = np.zeros((*rows.shape[:0:-1], most, keyframes)), np.zeros((most, keyframes))
    place = slot * keyframes + keyframe
    factor.ravel()[place] = weight
    columns = out.reshape(-1, most * keyframes)
    for column, values in zip(columns, rows.T.reshape(len(columns), -1), strict=True):
        column[place] = values
    return Rows(out.T, *rest, factor.T)
