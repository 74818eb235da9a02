"""Levenberg-Marquardt over all robots of a flight, with normal equations banded by time.

Robot r's part of a keyframe is (x, y, theta, wx, wy). The pose is in a frame that all robots share.
w is the error of the measured velocity in the robot's horizontal frame, which decays with its
correlation time. Measured motion is (1 + scale) times the true motion, so that a scale cannot
shrink path and noise together.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.odometry import QUARTER_TURN, RelativeMotion, rotate, rotation_matrix
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import (
    NormalEquations,
    marginal_covariances,
    solve_step,
)
from dmrl.estimation.solver.keyframes import NoiseModel

STATES_PER_ROBOT, CONSTANTS_PER_ROBOT, CONSTANTS_PER_LINK = 5, 4, 2
"""States of a robot at a keyframe; its constants (bias of the yaw rate, scale and two biases of the
velocity); constants of a link (offset and scale of its ranges)."""
MAX_ITERATIONS, TOLERANCE = 20, 1e-4
"""Largest number of iterations, and relative change of the cost that ends them. No record of how
the values were chosen."""
WEAK_INFORMATION = (1e-4, 1e-4, 1e-3, 1e-3, 1e-3)
"""Information added to every state of every robot, in inverse squares of its units; practically
none."""
ANCHOR_INFORMATION = 1e6
"""Information on the first robot's first pose, which defines the shared frame."""
MAX_DAMPING = 1e4
"""Damping beyond which the iteration ends. No record of how the value was chosen."""


@dataclass(frozen=True, slots=True)
class RangeLink:
    """R ranges between two robots.

    Parameters
    ----------
    robots
        Indices of the two robots.
    keyframe
        (R,) keyframe at or before each range.
    range_m
        (R,) measured ranges.
    own_shift_m, peer_shift_m
        (R, 2) motion of either robot from that keyframe to the range, in its own frame.
    height_m
        (R,) height of the second robot minus that of the first.
    """

    robots: tuple[int, int]
    keyframe: NDArray[np.intp]
    range_m: Array
    own_shift_m: Array
    peer_shift_m: Array
    height_m: Array


@dataclass(frozen=True, slots=True)
class SwarmProblem:
    """N robots cut into K keyframes.

    Parameters
    ----------
    names
        Names of the robots.
    keyframe_s
        (K,) times, seconds.
    motions
        K - 1 motions of each robot.
    paths
        Heading (K,) and position (K, 2) of each robot by dead reckoning.
    dropout_s
        (N, K - 1) seconds of each interval in which a robot's sensors dropped out.
    links
        Ranges, pair by pair.
    calibrated_std
        (4 N + 2 L,) standard deviations of the constants, in their order, as known from other
        flights; infinite elsewhere. None: no calibration.
    """

    names: list[str]
    keyframe_s: Array
    motions: list[RelativeMotion]
    paths: list[tuple[Array, Array]]
    dropout_s: Array
    links: list[RangeLink]
    calibrated_std: Array | None = None


@dataclass(frozen=True, slots=True)
class SwarmEstimate:
    """Solution: states (K, N, 5), constants (4 N + 2 L,), and half the sum of the losses."""

    state: Array
    constants: Array
    cost: float


@dataclass(frozen=True, slots=True)
class _WhitenedRows:
    """Whitened rows, each with its residual last: a robot's (K - 1, 5, 15), a link's (R, 9)."""

    steps: list[Array]
    ranges: list[Array]


def solve(problem: SwarmProblem, noise: NoiseModel, state: Array) -> SwarmEstimate:
    """Find the most likely flight near a first guess.

    Parameters
    ----------
    problem, noise
        Keyframes of the flight, and the noise model.
    state
        (K, N, 5) first guess.
    """
    constants = np.zeros(
        len(problem.names) * CONSTANTS_PER_ROBOT + len(problem.links) * CONSTANTS_PER_LINK
    )
    rows = _whiten_rows(problem, noise, state, constants)
    best = SwarmEstimate(state, constants, _total_cost(problem, noise, rows, constants))
    equations = _assemble_equations(problem, noise, rows, constants, _range_weights(noise, rows))
    damping = 0.0
    for _ in range(MAX_ITERATIONS):
        change, change_constants, *_ = solve_step(_add_damping(equations, damping))
        state = best.state + change.reshape(best.state.shape)
        constants = best.constants + change_constants
        rows = _whiten_rows(problem, noise, state, constants)
        cost = _total_cost(problem, noise, rows, constants)
        if not cost < best.cost:
            if damping > MAX_DAMPING:
                break
            damping = max(10 * damping, 1e-2)
            continue
        gained, best, damping = (
            best.cost - cost,
            SwarmEstimate(state, constants, cost),
            damping / 10,
        )
        if gained < TOLERANCE * cost:
            break
        equations = _assemble_equations(
            problem, noise, rows, constants, _range_weights(noise, rows)
        )
    return best


def marginals(
    problem: SwarmProblem, noise: NoiseModel, solution: SwarmEstimate, denoised: Array
) -> Array:
    """Return (K, 5 N, 5 N) marginal covariances of the keyframes.

    Parameters
    ----------
    problem, noise, solution
        A flight, its noise model and its solution, which determines the weights of the ranges.
    denoised
        (K, N, 5) the solution without probable noise, where the equations are linearized.
    """
    weights = _range_weights(
        noise, _whiten_rows(problem, noise, solution.state, solution.constants)
    )
    rows = _whiten_rows(problem, noise, denoised, solution.constants)
    equations = _assemble_equations(problem, noise, rows, solution.constants, weights)
    *_, response, covariance = solve_step(equations)
    spread = marginal_covariances(equations.diagonal, equations.off_diagonal)
    return np.asarray(spread + response @ covariance @ response.swapaxes(1, 2))


def _add_damping(equations: NormalEquations, damping: float) -> NormalEquations:
    eye = np.eye(equations.diagonal.shape[1])
    return replace(equations, diagonal=equations.diagonal * (1 + damping * eye))


def _prior_std(flight: SwarmProblem, noise: NoiseModel) -> Array:
    velocity = [noise.velocity_scale_std, *[noise.velocity_bias_std_mps] * 2]
    robots = [noise.gyro_std_radps, *velocity] * len(flight.names)
    usual = [*robots, *[noise.bias_std_m, noise.scale_std] * len(flight.links)]
    return np.minimum(usual, np.inf if flight.calibrated_std is None else flight.calibrated_std)


def _whiten_rows(
    flight: SwarmProblem, noise: NoiseModel, state: Array, constants: Array
) -> _WhitenedRows:
    own, shared = np.split(constants, [len(flight.names) * CONSTANTS_PER_ROBOT])
    own, shared = own.reshape(-1, CONSTANTS_PER_ROBOT), shared.reshape(-1, CONSTANTS_PER_LINK)
    return _WhitenedRows(
        [_step_rows(flight, noise, k, state[:, k], own[k]) for k in range(len(own))],
        [
            _range_rows(link, noise, state, both)
            for link, both in zip(flight.links, shared, strict=True)
        ],
    )


def _step_rows(
    flight: SwarmProblem, noise: NoiseModel, robot: int, state: Array, constants: Array
) -> Array:
    moves, step_s = flight.motions[robot], np.diff(flight.keyframe_s)
    half_s, kept = step_s[:, None] / 2, np.exp(-step_s / noise.velocity_tau_s)[:, None]
    gyro, gain, bias = constants[0], 1 + constants[1], constants[2:]
    back = rotation_matrix(-state[:-1, 2])
    way = rotate(back, np.diff(state[:, :2], axis=0))
    out = np.zeros((len(step_s), STATES_PER_ROBOT, 2 * STATES_PER_ROBOT + CONSTANTS_PER_ROBOT + 1))
    error, error_ahead = state[:-1, 3:], state[1:, 3:]
    shift = (
        gain * way - moves.shift_m + moves.bias_jacobian_s @ bias + half_s * (error + error_ahead)
    )
    turn = np.diff(state[:, 2]) - moves.turn_rad + gyro * step_s
    out[..., -1] = np.column_stack([shift, turn, error_ahead - kept * error])
    out[:, :2, :2], out[:, :2, STATES_PER_ROBOT : STATES_PER_ROBOT + 2] = -gain * back, gain * back
    out[:, :2, 2] = -gain * way @ QUARTER_TURN.T
    out[:, [0, 1], [3, 4]] = out[:, [0, 1], [STATES_PER_ROBOT + 3, STATES_PER_ROBOT + 4]] = half_s
    out[:, 2, 2], out[:, 2, STATES_PER_ROBOT + 2] = -1.0, 1.0
    out[:, [3, 4], [3, 4]], out[:, [3, 4], [STATES_PER_ROBOT + 3, STATES_PER_ROBOT + 4]] = (
        -kept,
        1.0,
    )
    out[:, 2, 2 * STATES_PER_ROBOT], out[:, :2, 2 * STATES_PER_ROBOT + 1] = step_s, way
    out[:, :2, 2 * STATES_PER_ROBOT + 2 : -1] = moves.bias_jacobian_s
    gap_s = flight.dropout_s[robot] / 2
    moved = noise.velocity_white_psd * step_s + noise.dropout_speed_mps**2 * gap_s
    turned = noise.yaw_rate_psd * step_s + noise.dropout_turn_radps**2 * gap_s
    faded = noise.velocity_std_mps**2 * (1 - np.exp(-2 * step_s / noise.velocity_tau_s))
    variance = np.column_stack([moved, moved, turned, faded, faded])
    return np.asarray(out / np.sqrt(variance)[..., None])


def _range_rows(link: RangeLink, noise: NoiseModel, state: Array, constants: Array) -> Array:
    here, there = (state[link.keyframe, robot] for robot in link.robots)
    own = rotate(rotation_matrix(here[:, 2]), link.own_shift_m)
    peer = rotate(rotation_matrix(there[:, 2]), link.peer_shift_m)
    offset = there[:, :2] + peer - here[:, :2] - own
    distance = np.sqrt((offset**2).sum(axis=1) + link.height_m**2) + 1e-6
    towards, gain = offset / distance[:, None], 1 + constants[1]
    out = np.empty((len(distance), 2 * 3 + CONSTANTS_PER_LINK + 1))
    out[:, :2], out[:, 3:5] = gain * towards, -gain * towards
    out[:, 2] = gain * (towards * (own @ QUARTER_TURN.T)).sum(axis=1)
    out[:, 5] = -gain * (towards * (peer @ QUARTER_TURN.T)).sum(axis=1)
    out[:, 6], out[:, 7] = -1.0, -distance
    out[:, 8] = link.range_m - gain * distance - constants[0]
    return out / noise.range_std_m


def _range_loss_scale(noise: NoiseModel) -> float:
    """Return the loss scale of the whitened ranges."""
    return (noise.range_loss_scale_m / noise.range_std_m) ** 2


def _range_weights(noise: NoiseModel, rows: _WhitenedRows) -> list[Array]:
    """Return the Cauchy weight of every range."""
    return [1 / (1 + ranges[:, -1] ** 2 / _range_loss_scale(noise)) for ranges in rows.ranges]


def _total_cost(
    flight: SwarmProblem, noise: NoiseModel, rows: _WhitenedRows, constants: Array
) -> float:
    limit = _range_loss_scale(noise)
    steps = sum(float((steps[..., -1] ** 2).sum()) for steps in rows.steps)
    ranges = sum(float(np.log1p(r[:, -1] ** 2 / limit).sum()) for r in rows.ranges)
    prior = float(((constants / _prior_std(flight, noise)) ** 2).sum())
    return (steps + limit * ranges + prior) / 2


def _assemble_equations(
    flight: SwarmProblem,
    noise: NoiseModel,
    rows: _WhitenedRows,
    constants: Array,
    weights: list[Array],
) -> NormalEquations:
    keyframes, robots = len(flight.keyframe_s), len(flight.names)
    size, information = robots * STATES_PER_ROBOT, _prior_std(flight, noise) ** -2.0
    equations = NormalEquations(
        np.zeros((keyframes, size, size)) + np.diag(np.tile(WEAK_INFORMATION, robots)),
        np.zeros((keyframes - 1, size, size)),
        np.zeros((keyframes, size, len(constants))),
        np.diag(information),
        np.zeros((keyframes, size)),
        information * constants,
    )
    equations.diagonal[0, :3, :3] += ANCHOR_INFORMATION * np.eye(3)
    for robot, steps in enumerate(rows.steps):
        _add_steps(equations, robot, steps)
    for number, (link, ranges) in enumerate(zip(flight.links, rows.ranges, strict=True)):
        if len(ranges):
            first = robots * CONSTANTS_PER_ROBOT + number * CONSTANTS_PER_LINK
            _add_ranges(
                equations, link, ranges, weights[number], slice(first, first + CONSTANTS_PER_LINK)
            )
    return equations


def _add_steps(equations: NormalEquations, robot: int, steps: Array) -> None:
    mine = slice(robot * STATES_PER_ROBOT, (robot + 1) * STATES_PER_ROBOT)
    own = slice(robot * CONSTANTS_PER_ROBOT, (robot + 1) * CONSTANTS_PER_ROBOT)
    products = steps.swapaxes(1, 2) @ steps
    for keyframes, part in (
        (slice(-1), slice(STATES_PER_ROBOT)),
        (slice(1, None), slice(STATES_PER_ROBOT, 2 * STATES_PER_ROBOT)),
    ):
        equations.diagonal[keyframes, mine, mine] += products[:, part, part]
        equations.coupling[keyframes, mine, own] += products[:, part, 2 * STATES_PER_ROBOT : -1]
        equations.gradient[keyframes, mine] += products[:, part, -1]
    equations.off_diagonal[:, mine, mine] += products[
        :, :STATES_PER_ROBOT, STATES_PER_ROBOT : 2 * STATES_PER_ROBOT
    ]
    rest = products[:, 2 * STATES_PER_ROBOT :, 2 * STATES_PER_ROBOT :].sum(axis=0)
    equations.globals_block[own, own] += rest[:-1, :-1]
    equations.globals_gradient[own] += rest[:-1, -1]


def _add_ranges(
    equations: NormalEquations, link: RangeLink, ranges: Array, weight: Array, shared: slice
) -> None:
    both = np.concatenate([robot * STATES_PER_ROBOT + np.arange(3) for robot in link.robots])
    products = (ranges * weight[:, None])[:, :, None] * ranges[:, None, :]
    first = np.flatnonzero(np.diff(link.keyframe, prepend=-1))
    keys, sums = link.keyframe[first], np.add.reduceat(products, first, axis=0)
    equations.diagonal[np.ix_(keys, both, both)] += sums[:, :6, :6]
    equations.coupling[np.ix_(keys, both, np.arange(shared.start, shared.stop))] += sums[:, :6, 6:8]
    equations.gradient[np.ix_(keys, both)] += sums[:, :6, 8]
    rest = sums.sum(axis=0)
    equations.globals_block[shared, shared] += rest[6:8, 6:8]
    equations.globals_gradient[shared] += rest[6:8, 8]
