"""Covariances that are large enough: noise in a robot's log does not count as motion.

A robot's motion tells in which direction its peer is: if the whole solution is turned, the ranges
no longer fit the motion. Gauss-Newton takes the measured motion for the true one. So the noise in
the log of a robot that stands still seems to fix the bearing, as a flight would.

Therefore the covariance is not taken at the solution, but at a smoothed copy of it. There,
motion is averaged over most of a second. The observer's motion, and the peer's relative to it,
are shrunk where they are no larger than their noise. A static observer or a parallel flight then
leaves the bearing open.
"""

from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from dmrl.estimation.model.odometry import Increments, rotate, rotation
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import Normal, block_inverse, solve
from dmrl.estimation.solver.camera_residuals import Looks, Seen, picked
from dmrl.estimation.solver.keyframes import Noise, Problem
from dmrl.estimation.solver.levenberg_marquardt import Solution, equations_of
from dmrl.estimation.solver.residuals import BIAS, SCALE, linearise
from dmrl.estimation.solver.robust_loss import curvature_of, weights_of

CALM_S = 0.8
"""Moving average: what is faster than robots fly is noise."""
RESTLESS_S = 1.5
"""The same, where it is asked whether a robot moves at all."""
WINDOW_S = 10.0
"""Over which motion is held against its noise."""
NOISE_FACTOR = 1.8
"""Motion must exceed its noise's energy by this: 10 s of noise reach it in a few per cent."""
NOISE, CONSTANT_RANGE, CONSTANT = 1.25, 1.15, 1.4
"""Sigmas that come from noise, from offset and scale of the ranges, and from what else is constant,
are this much larger. No noise of a sensor is quite what the solve believes; and no average over a
flight makes an error smaller that is constant, so where it is outside its ellipse, all of the
flight is. Real velocities have larger scales and biases than their priors say, and scales that
differ by axis."""


def covariance(problem: Problem, noise: Noise, solution: Solution) -> tuple[Array, Array]:
    """Covariances of a solution's keyframes and globals.

    Returns
    -------
    keyframes : Array
        (K, 6, 6) of x, y (m), psi (rad), wx, wy (m/s), b (m).
    constants : Array
        (G, G), in the order of ``GLOBALS``.
    """
    if problem.looks is not None:
        problem = replace(problem, looks=picked(problem.looks, solution.state))
    at_solution = linearise(problem, noise, solution.state, solution.constants)
    calm, state = calmed(problem, noise, solution.state)
    linear = linearise(calm, noise, state, solution.constants)
    # The calmed copy does not fit the ranges; their weights come from the solution.
    linear.ranges[:, -1] = at_solution.range
    if linear.seen is not None and at_solution.seen is not None:
        linear.seen.rows[..., -1] = at_solution.seen.rows[..., -1]
        linear.seen.beyond[:] = at_solution.seen.beyond
    equations = equations_of(calm, noise, linear, solution.constants)
    weights = weights_of(linear, noise, solution.constants)
    held = curvature_of(noise, solution.constants) - weights.prior * noise.prior_std() ** -2
    equations.corner[...] += np.diag(held)
    keyframes, constants = _inverse(equations)
    if problem.looks is not None and linear.seen is not None and weights.seen is not None:
        keyframes += _shared(equations, problem.looks, linear.seen, weights.seen)
    return keyframes, constants


def _shared(equations: Normal, looks: Looks, found: Seen, weight: Array) -> Array:
    """(K, 6, 6) what an error adds that all images of a camera share: of a mount, or a network.

    It is not solved for, but considered (Schmidt 1966): one as large as that of a single image in
    azimuth, for either camera.
    """
    out = np.zeros_like(equations.diagonal)
    for side in (1, -1):
        mine = weight * (looks.side == side)
        gradient = np.zeros_like(equations.gradient)
        pulled, part = found.rows[:, 0, :3] * mine[:, None], looks.part[:, None]
        np.add.at(gradient[:, :3], looks.key, (1 - part) * pulled)
        np.add.at(gradient[:, :3], looks.key + 1, part * pulled)
        nothing = np.zeros_like(equations.corner_gradient)
        moved = solve(replace(equations, gradient=gradient, corner_gradient=nothing))[0]
        out += moved[:, :, None] * moved[:, None, :]
    return out


def _inverse(equations: Normal) -> tuple[Array, Array]:
    *_, response, constants = solve(equations)
    keyframes = NOISE**2 * block_inverse(equations.diagonal, equations.above)
    wider = np.full(len(constants), CONSTANT)
    wider[[BIAS, SCALE]] = CONSTANT_RANGE
    response = response * wider
    return keyframes + response @ constants @ response.swapaxes(1, 2), constants


def calmed(problem: Problem, noise: Noise, state: Array) -> tuple[Problem, Array]:
    """A flight and its solution without what may be noise, to linearise at.

    Parameters
    ----------
    problem, noise
        The flight, and what is believed about its sensors.
    state
        (K, 6) its solution.
    """
    step_s = float(np.median(problem.steps_s))
    own_heading, own = path_of(problem.own)
    relative = rotate(rotation(own_heading), state[:, :2])
    single = noise_energy(noise)
    own_steps = shrunk(np.diff(own, axis=0) / step_s, single, step_s) * step_s
    relative_steps = shrunk(np.diff(relative, axis=0) / step_s, 2 * single, step_s) * step_s
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(relative_steps, axis=0)])
    path += relative.mean(axis=0) - path.mean(axis=0)

    out = np.zeros_like(state)
    out[:, :2] = rotate(rotation(-own_heading), path)
    out[:, 2] = state[:, 2]
    own_shift = rotate(rotation(-own_heading[:-1]), own_steps)
    # The peer's own way is the observer's and the relative one, turned into the peer's frame.
    peer_heading = own_heading[:-1] + state[:-1, 2]
    peer_shift = rotate(rotation(-peer_heading), own_steps + relative_steps)
    return replace(
        problem,
        own=replace(problem.own, shift_m=own_shift),
        peer=replace(problem.peer, shift_m=peer_shift),
    ), out


def noise_energy(noise: Noise) -> float:
    """Mean square of one velocity's noise after the moving average, both axes, (m/s)^2.

    At least that of the default: motion that shows how good the logs are is enough motion.
    """
    return 2 * max(noise.velocity_psd, Noise().velocity_psd) / CALM_S


def shrunk(velocity: Array, energy: float, step_s: float) -> Array:
    """(K - 1, 2) averaged velocities, shrunk towards zero by their share of noise.

    Parameters
    ----------
    velocity
        (K - 1, 2) m/s.
    energy
        Mean square of their noise after the average, (m/s)^2.
    step_s
        Seconds between them.
    """
    slow = uniform_filter1d(velocity, max(1, round(CALM_S / step_s)), axis=0, mode="nearest")
    window = max(1, round(WINDOW_S / step_s))
    seen = uniform_filter1d((slow**2).sum(axis=1), window, mode="nearest")
    # What was seen is motion and noise, whose energies add: motion's share is the rest.
    share = np.sqrt(np.maximum(1 - NOISE_FACTOR * energy / np.maximum(seen, 1e-12), 0.0))
    return np.asarray(slow * share[:, None])


def restlessness(problem: Problem, state: Array) -> tuple[float, float, float]:
    """Mean squares of the averaged velocities of observer, peer, and one against the other.

    Parameters
    ----------
    problem
        The flight.
    state
        (K, 3) or (K, 6) its solution.

    Returns
    -------
    own, peer, relative : float
        (m/s)^2, noise included.
    """
    step_s = float(np.median(problem.steps_s))
    heading, own = path_of(problem.own)
    relative = rotate(rotation(heading), state[:, :2])
    energies = []
    for path in (own, path_of(problem.peer)[1], relative):
        velocity = np.diff(path, axis=0) / step_s
        slow = uniform_filter1d(
            velocity, max(1, round(RESTLESS_S / step_s)), axis=0, mode="nearest"
        )
        energies.append(float((slow**2).sum(axis=1).mean()))
    return energies[0], energies[1], energies[2]


def path_of(moves: Increments) -> tuple[Array, Array]:
    """Heading (K,) and position (K, 2) of a robot in the frame of its first keyframe."""
    heading = np.concatenate([[0.0], np.cumsum(moves.turn_rad)])
    steps = rotate(rotation(heading[:-1]), moves.shift_m)
    return heading, np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
