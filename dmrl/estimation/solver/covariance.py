"""Covariance of a solution, taken where measurement noise does not count as motion.

The motion of a robot makes the bearing to its peer observable: if the whole solution is turned, the
ranges no longer fit the motion. Gauss-Newton treats the measured motion as exact. So the noise in
the log of a robot at rest seems to fix the bearing, as a flight would.

Therefore the covariance is computed at a smoothed copy of the solution. Its motion is averaged over
most of a second. The observer's motion, and the peer's motion relative to it, are shrunk where they
do not exceed their noise. A static observer or a parallel flight then leaves the bearing open.
"""

from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from dmrl.estimation.model.odometry import RelativeMotion, rotate, rotation_matrix
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import (
    NormalEquations,
    marginal_covariances,
    solve_step,
)
from dmrl.estimation.solver.camera_residuals import (
    CameraMeasurements,
    CameraResiduals,
    select_associated,
)
from dmrl.estimation.solver.keyframes import KeyframeProblem, NoiseModel
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate, build_equations
from dmrl.estimation.solver.residuals import RANGE_BIAS, RANGE_SCALE, linearize
from dmrl.estimation.solver.robust_loss import irls_weights, prior_curvature

SMOOTHING_S = 0.8
"""Window of the moving average of velocities, seconds. Robots do not change their velocity faster
than this. No record of how the value was chosen."""
MOTION_WINDOW_S = 1.5
"""Window of the same average when the motion of a robot is measured, seconds. No record of how the
value was chosen."""
NOISE_WINDOW_S = 10.0
"""Window over which motion is compared with its noise, seconds. No record of how the value was
chosen."""
MIN_ENERGY_RATIO = 1.8
"""Motion must exceed the energy of its noise by this factor. 10 s of pure noise reach it in a few
per cent of all cases."""
NOISE_INFLATION, RANGE_CONSTANT_INFLATION, CONSTANT_INFLATION = 1.25, 1.15, 1.4
"""Factors of the sigmas: of errors from noise, of offset and scale of the ranges, of all other
constants.

The noise of a real sensor differs from its model. An average over a flight does not reduce a
constant error, so a flight whose constant is outside its ellipse is outside throughout. Real
velocities have larger scales and biases than their priors, and scales that differ by axis. Chosen
for fewer bad labels among the kept ones on every simulated set."""


def compute_covariance(
    problem: KeyframeProblem, noise: NoiseModel, solution: MapEstimate
) -> tuple[Array, Array]:
    """Compute the covariances of a solution's keyframes and constants.

    Parameters
    ----------
    problem, noise
        Keyframes of the flight, and the noise model.
    solution
        Solution of the flight.

    Returns
    -------
    keyframes : Array
        (K, 6, 6) of x, y (m), psi (rad), wx, wy (m/s), b (m).
    constants : Array
        (G, G), in the order of ``GLOBALS``.
    """
    if problem.camera is not None:
        problem = replace(problem, camera=select_associated(problem.camera, solution.state))
    at_solution = linearize(problem, noise, solution.state, solution.constants)
    calm, state = denoise_for_covariance(problem, noise, solution.state)
    linear = linearize(calm, noise, state, solution.constants)
    # The denoised copy does not fit the ranges, so their weights come from the solution.
    linear.ranges[:, -1] = at_solution.range
    if linear.camera is not None and at_solution.camera is not None:
        linear.camera.rows[..., -1] = at_solution.camera.rows[..., -1]
        linear.camera.excess[:] = at_solution.camera.excess
    equations = build_equations(calm, noise, linear, solution.constants)
    weights = irls_weights(linear, noise, solution.constants)
    held = prior_curvature(noise, solution.constants) - weights.prior * noise.prior_std() ** -2
    equations.globals_block[...] += np.diag(held)
    keyframes, constants = _inflate_marginals(equations)
    if problem.camera is not None and linear.camera is not None and weights.camera is not None:
        keyframes += _camera_covariance(equations, problem.camera, linear.camera, weights.camera)
    return keyframes, constants


def _camera_covariance(
    equations: NormalEquations, looks: CameraMeasurements, found: CameraResiduals, weight: Array
) -> Array:
    """Return (K, 6, 6) the covariance from an error that all images of a camera share.

    Such errors come from a mount or a network. They are considered, not solved for (Schmidt 1966):
    one for either camera, as large as the azimuth error of a single image.
    """
    out = np.zeros_like(equations.diagonal)
    for side in (1, -1):
        mine = weight * (looks.observer_sign == side)
        gradient = np.zeros_like(equations.gradient)
        pulled, part = found.rows[:, 0, :3] * mine[:, None], looks.fraction[:, None]
        np.add.at(gradient[:, :3], looks.keyframe, (1 - part) * pulled)
        np.add.at(gradient[:, :3], looks.keyframe + 1, part * pulled)
        nothing = np.zeros_like(equations.globals_gradient)
        moved = solve_step(replace(equations, gradient=gradient, globals_gradient=nothing))[0]
        out += moved[:, :, None] * moved[:, None, :]
    return out


def _inflate_marginals(equations: NormalEquations) -> tuple[Array, Array]:
    """Return inflated covariances of keyframes (K, n, n) and plain ones of the constants (G, G)."""
    *_, response, constants = solve_step(equations)
    keyframes = NOISE_INFLATION**2 * marginal_covariances(
        equations.diagonal, equations.off_diagonal
    )
    wider = np.full(len(constants), CONSTANT_INFLATION)
    wider[[RANGE_BIAS, RANGE_SCALE]] = RANGE_CONSTANT_INFLATION
    response = response * wider
    return keyframes + response @ constants @ response.swapaxes(1, 2), constants


def denoise_for_covariance(
    problem: KeyframeProblem, noise: NoiseModel, state: Array
) -> tuple[KeyframeProblem, Array]:
    """Return a flight and its solution without probable noise, for the linearization.

    Parameters
    ----------
    problem, noise
        Keyframes of the flight, and the noise model.
    state
        (K, 6) states of the solution.
    """
    step_s = float(np.median(problem.steps_s))
    own_heading, own = integrate_path(problem.own)
    relative = rotate(rotation_matrix(own_heading), state[:, :2])
    single = velocity_noise_power(noise)
    own_steps = shrink_to_signal(np.diff(own, axis=0) / step_s, single, step_s) * step_s
    relative_steps = (
        shrink_to_signal(np.diff(relative, axis=0) / step_s, 2 * single, step_s) * step_s
    )
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(relative_steps, axis=0)])
    path += relative.mean(axis=0) - path.mean(axis=0)

    out = np.zeros_like(state)
    out[:, :2] = rotate(rotation_matrix(-own_heading), path)
    out[:, 2] = state[:, 2]
    own_shift = rotate(rotation_matrix(-own_heading[:-1]), own_steps)
    # The peer's own path is the observer's plus the relative one, rotated into the peer's frame.
    peer_heading = own_heading[:-1] + state[:-1, 2]
    peer_shift = rotate(rotation_matrix(-peer_heading), own_steps + relative_steps)
    return replace(
        problem,
        own=replace(problem.own, shift_m=own_shift),
        peer=replace(problem.peer, shift_m=peer_shift),
    ), out


def velocity_noise_power(noise: NoiseModel) -> float:
    """Return the mean square of one velocity's noise after the average, both axes, (m/s)^2.

    It is at least that of the default model: motion that reveals good logs is sufficient motion.
    """
    return 2 * max(noise.velocity_psd, NoiseModel().velocity_psd) / SMOOTHING_S


def shrink_to_signal(velocity: Array, energy: float, step_s: float) -> Array:
    """Return (K - 1, 2) averaged velocities, shrunk towards zero by their share of noise.

    Parameters
    ----------
    velocity
        (K - 1, 2) m/s.
    energy
        Mean square of their noise after the average, (m/s)^2.
    step_s
        Seconds between samples.
    """
    slow = uniform_filter1d(velocity, max(1, round(SMOOTHING_S / step_s)), axis=0, mode="nearest")
    window = max(1, round(NOISE_WINDOW_S / step_s))
    seen = uniform_filter1d((slow**2).sum(axis=1), window, mode="nearest")
    # The energies of motion and noise add up to the measured one, so motion's share is the rest.
    share = np.sqrt(np.maximum(1 - MIN_ENERGY_RATIO * energy / np.maximum(seen, 1e-12), 0.0))
    return np.asarray(slow * share[:, None])


def motion_energy(problem: KeyframeProblem, state: Array) -> tuple[float, float, float]:
    """Return mean squares of the averaged own, peer and relative velocity.

    Parameters
    ----------
    problem
        Keyframes of the flight.
    state
        (K, 3) or (K, 6) states of the solution.

    Returns
    -------
    own, peer, relative : float
        (m/s)^2, noise included.
    """
    step_s = float(np.median(problem.steps_s))
    heading, own = integrate_path(problem.own)
    relative = rotate(rotation_matrix(heading), state[:, :2])
    energies = []
    for path in (own, integrate_path(problem.peer)[1], relative):
        velocity = np.diff(path, axis=0) / step_s
        slow = uniform_filter1d(
            velocity, max(1, round(MOTION_WINDOW_S / step_s)), axis=0, mode="nearest"
        )
        energies.append(float((slow**2).sum(axis=1).mean()))
    return energies[0], energies[1], energies[2]


def integrate_path(moves: RelativeMotion) -> tuple[Array, Array]:
    """Return heading (K,) and position (K, 2) of a robot in the frame of its first keyframe."""
    heading = np.concatenate([[0.0], np.cumsum(moves.turn_rad)])
    steps = rotate(rotation_matrix(heading[:-1]), moves.shift_m)
    return heading, np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
