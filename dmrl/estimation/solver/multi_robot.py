"""Levenberg-Marquardt over all robots of a flight, with normal equations banded by time.

Robot r's part of a keyframe is (x, y, theta, wx, wy). The pose is in a frame that all robots share.
w is the error of the measured velocity in the robot's horizontal frame, which decays with its
correlation time. Measured motion is (1 + scale) times the true motion, so that a scale cannot
shrink path and noise together.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.odometry import QUARTER_TURN, Increments, rotate, rotation
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import Normal, block_inverse, solve
from dmrl.estimation.solver.keyframes import Noise

OWN, ROBOT, SHARED = 5, 4, 2
"""States of a robot at a keyframe; its constants (bias of the yaw rate, scale and two biases of the
velocity); constants of a link (offset and scale of its ranges)."""
ITERATIONS, TOLERANCE = 20, 1e-4
"""Largest number of iterations, and relative change of the cost that ends them. No record of how
the values were chosen."""
WEAK = (1e-4, 1e-4, 1e-3, 1e-3, 1e-3)
"""Information added to every state of every robot, in inverse squares of its units; practically
none."""
ANCHOR = 1e6
"""Information on the first robot's first pose, which defines the shared frame."""
MOST_DAMPING = 1e4
"""Damping beyond which the iteration ends. No record of how the value was chosen."""


@dataclass(frozen=True, slots=True)
class Link:
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
    key: NDArray[np.intp]
    range_m: Array
    own_shift_m: Array
    peer_shift_m: Array
    height_m: Array


@dataclass(frozen=True, slots=True)
class Flight:
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
    key_s: Array
    moves: list[Increments]
    paths: list[tuple[Array, Array]]
    gap_s: Array
    links: list[Link]
    known_std: Array | None = None


@dataclass(frozen=True, slots=True)
class Swarm:
    """Solution: states (K, N, 5), constants (4 N + 2 L,), and half the sum of the losses."""

    state: Array
    constants: Array
    cost: float


@dataclass(frozen=True, slots=True)
class _Rows:
    """Whitened rows, each with its residual last: a robot's (K - 1, 5, 15), a link's (R, 9)."""

    steps: list[Array]
    ranges: list[Array]


def solved(flight: Flight, noise: Noise, state: Array) -> Swarm:
    """Find the most likely flight near a first guess.

    Parameters
    ----------
    problem, noise
        Keyframes of the flight, and the noise model.
    state
        (K, N, 5) first guess.
    """
    constants = np.zeros(len(flight.names) * ROBOT + len(flight.links) * SHARED)
    rows = _rows(flight, noise, state, constants)
    best = Swarm(state, constants, _cost(flight, noise, rows, constants))
    equations = _equations(flight, noise, rows, constants, _weights(noise, rows))
    damping = 0.0
    for _ in range(ITERATIONS):
        change, change_constants, *_ = solve(_damped(equations, damping))
        state = best.state + change.reshape(best.state.shape)
        constants = best.constants + change_constants
        rows = _rows(flight, noise, state, constants)
        cost = _cost(flight, noise, rows, constants)
        if not cost < best.cost:
            if damping > MOST_DAMPING:
                break
            damping = max(10 * damping, 1e-2)
            continue
        gained, best, damping = best.cost - cost, Swarm(state, constants, cost), damping / 10
        if gained < TOLERANCE * cost:
            break
        equations = _equations(flight, noise, rows, constants, _weights(noise, rows))
    return best


def inverse(flight: Flight, noise: Noise, found: Swarm, calm: Array) -> Array:
    """Return (K, 5 N, 5 N) marginal covariances of the keyframes.

    Parameters
    ----------
    problem, noise, solution
        A flight, its noise model and its solution, which determines the weights of the ranges.
    denoised
        (K, N, 5) the solution without probable noise, where the equations are linearized.
    """
    weights = _weights(noise, _rows(flight, noise, found.state, found.constants))
    rows = _rows(flight, noise, calm, found.constants)
    equations = _equations(flight, noise, rows, found.constants, weights)
    *_, response, covariance = solve(equations)
    spread = block_inverse(equations.diagonal, equations.above)
    return np.asarray(spread + response @ covariance @ response.swapaxes(1, 2))


def _damped(equations: Normal, damping: float) -> Normal:
    eye = np.eye(equations.diagonal.shape[1])
    return replace(equations, diagonal=equations.diagonal * (1 + damping * eye))


def _prior_std(flight: Flight, noise: Noise) -> Array:
    velocity = [noise.velocity_scale_std, *[noise.velocity_bias_std_mps] * 2]
    robots = [noise.gyro_std_radps, *velocity] * len(flight.names)
    usual = [*robots, *[noise.bias_std_m, noise.scale_std] * len(flight.links)]
    return np.minimum(usual, np.inf if flight.known_std is None else flight.known_std)


def _rows(flight: Flight, noise: Noise, state: Array, constants: Array) -> _Rows:
    own, shared = np.split(constants, [len(flight.names) * ROBOT])
    own, shared = own.reshape(-1, ROBOT), shared.reshape(-1, SHARED)
    return _Rows(
        [_steps(flight, noise, k, state[:, k], own[k]) for k in range(len(own))],
        [
            _ranges(link, noise, state, both)
            for link, both in zip(flight.links, shared, strict=True)
        ],
    )


def _steps(flight: Flight, noise: Noise, robot: int, state: Array, constants: Array) -> Array:
    moves, step_s = flight.moves[robot], np.diff(flight.key_s)
    half_s, kept = step_s[:, None] / 2, np.exp(-step_s / noise.velocity_tau_s)[:, None]
    gyro, gain, bias = constants[0], 1 + constants[1], constants[2:]
    back = rotation(-state[:-1, 2])
    way = rotate(back, np.diff(state[:, :2], axis=0))
    out = np.zeros((len(step_s), OWN, 2 * OWN + ROBOT + 1))
    error, error_ahead = state[:-1, 3:], state[1:, 3:]
    shift = gain * way - moves.shift_m + moves.drift_s @ bias + half_s * (error + error_ahead)
    turn = np.diff(state[:, 2]) - moves.turn_rad + gyro * step_s
    out[..., -1] = np.column_stack([shift, turn, error_ahead - kept * error])
    out[:, :2, :2], out[:, :2, OWN : OWN + 2] = -gain * back, gain * back
    out[:, :2, 2] = -gain * way @ QUARTER_TURN.T
    out[:, [0, 1], [3, 4]] = out[:, [0, 1], [OWN + 3, OWN + 4]] = half_s
    out[:, 2, 2], out[:, 2, OWN + 2] = -1.0, 1.0
    out[:, [3, 4], [3, 4]], out[:, [3, 4], [OWN + 3, OWN + 4]] = -kept, 1.0
    out[:, 2, 2 * OWN], out[:, :2, 2 * OWN + 1] = step_s, way
    out[:, :2, 2 * OWN + 2 : -1] = moves.drift_s
    gap_s = flight.gap_s[robot] / 2
    moved = noise.velocity_white_psd * step_s + noise.gap_speed_mps**2 * gap_s
    turned = noise.yaw_rate_psd * step_s + noise.gap_turn_radps**2 * gap_s
    faded = noise.velocity_std_mps**2 * (1 - np.exp(-2 * step_s / noise.velocity_tau_s))
    variance = np.column_stack([moved, moved, turned, faded, faded])
    return np.asarray(out / np.sqrt(variance)[..., None])


def _ranges(link: Link, noise: Noise, state: Array, constants: Array) -> Array:
    here, there = (state[link.key, robot] for robot in link.robots)
    own = rotate(rotation(here[:, 2]), link.own_shift_m)
    peer = rotate(rotation(there[:, 2]), link.peer_shift_m)
    offset = there[:, :2] + peer - here[:, :2] - own
    distance = np.sqrt((offset**2).sum(axis=1) + link.height_m**2) + 1e-6
    towards, gain = offset / distance[:, None], 1 + constants[1]
    out = np.empty((len(distance), 2 * 3 + SHARED + 1))
    out[:, :2], out[:, 3:5] = gain * towards, -gain * towards
    out[:, 2] = gain * (towards * (own @ QUARTER_TURN.T)).sum(axis=1)
    out[:, 5] = -gain * (towards * (peer @ QUARTER_TURN.T)).sum(axis=1)
    out[:, 6], out[:, 7] = -1.0, -distance
    out[:, 8] = link.range_m - gain * distance - constants[0]
    return out / noise.range_std_m


def _limit(noise: Noise) -> float:
    """Return the loss scale of the whitened ranges."""
    return (noise.cauchy_m / noise.range_std_m) ** 2


def _weights(noise: Noise, rows: _Rows) -> list[Array]:
    """Return the Cauchy weight of every range."""
    return [1 / (1 + ranges[:, -1] ** 2 / _limit(noise)) for ranges in rows.ranges]


def _cost(flight: Flight, noise: Noise, rows: _Rows, constants: Array) -> float:
    limit = _limit(noise)
    steps = sum(float((steps[..., -1] ** 2).sum()) for steps in rows.steps)
    ranges = sum(float(np.log1p(r[:, -1] ** 2 / limit).sum()) for r in rows.ranges)
    prior = float(((constants / _prior_std(flight, noise)) ** 2).sum())
    return (steps + limit * ranges + prior) / 2


def _equations(
    flight: Flight, noise: Noise, rows: _Rows, constants: Array, weights: list[Array]
) -> Normal:
    keyframes, robots = len(flight.key_s), len(flight.names)
    size, information = robots * OWN, _prior_std(flight, noise) ** -2.0
    equations = Normal(
        np.zeros((keyframes, size, size)) + np.diag(np.tile(WEAK, robots)),
        np.zeros((keyframes - 1, size, size)),
        np.zeros((keyframes, size, len(constants))),
        np.diag(information),
        np.zeros((keyframes, size)),
        information * constants,
    )
    equations.diagonal[0, :3, :3] += ANCHOR * np.eye(3)
    for robot, steps in enumerate(rows.steps):
        _add_steps(equations, robot, steps)
    for number, (link, ranges) in enumerate(zip(flight.links, rows.ranges, strict=True)):
        if len(ranges):
            first = robots * ROBOT + number * SHARED
            _add_ranges(equations, link, ranges, weights[number], slice(first, first + SHARED))
    return equations


def _add_steps(equations: Normal, robot: int, steps: Array) -> None:
    mine = slice(robot * OWN, (robot + 1) * OWN)
    own = slice(robot * ROBOT, (robot + 1) * ROBOT)
    products = steps.swapaxes(1, 2) @ steps
    for keyframes, part in ((slice(-1), slice(OWN)), (slice(1, None), slice(OWN, 2 * OWN))):
        equations.diagonal[keyframes, mine, mine] += products[:, part, part]
        equations.border[keyframes, mine, own] += products[:, part, 2 * OWN : -1]
        equations.gradient[keyframes, mine] += products[:, part, -1]
    equations.above[:, mine, mine] += products[:, :OWN, OWN : 2 * OWN]
    rest = products[:, 2 * OWN :, 2 * OWN :].sum(axis=0)
    equations.corner[own, own] += rest[:-1, :-1]
    equations.corner_gradient[own] += rest[:-1, -1]


def _add_ranges(equations: Normal, link: Link, ranges: Array, weight: Array, shared: slice) -> None:
    both = np.concatenate([robot * OWN + np.arange(3) for robot in link.robots])
    products = (ranges * weight[:, None])[:, :, None] * ranges[:, None, :]
    first = np.flatnonzero(np.diff(link.key, prepend=-1))
    keys, sums = link.key[first], np.add.reduceat(products, first, axis=0)
    equations.diagonal[np.ix_(keys, both, both)] += sums[:, :6, :6]
    equations.border[np.ix_(keys, both, np.arange(shared.start, shared.stop))] += sums[:, :6, 6:8]
    equations.gradient[np.ix_(keys, both)] += sums[:, :6, 8]
    rest = sums.sum(axis=0)
    equations.corner[shared, shared] += rest[6:8, 6:8]
    equations.corner_gradient[shared] += rest[6:8, 8]
