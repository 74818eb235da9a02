"""Covariance of a solution, taken where measurement noise does not count as motion.

The motion of a robot makes the bearing to its peer observable: if the whole solution is turned, the
ranges no longer fit the motion. Gauss-Newton treats the solved motion as exact. So the noise in the
log of a robot at rest seems to fix the bearing, as a flight would.

Therefore the equations are linearized at a calm copy of the solution. A short-time Fourier
transform separates each robot's velocity into frequencies. Those without more energy than the noise
of the odometry vanish. Slow motion that lasts has its energy at low frequencies and stays.

What vanishes adds up over time, so the calm copy is some tenths of a metre off and sees the peer in
another direction. The ranges fix the distance there, not a direction of the solution. So relative
covariances are turned by the difference of the bearings.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.odometry import QUARTER_TURN, rotation_matrix
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import marginal_covariances, solve_step
from dmrl.estimation.solver.equations import build_equations
from dmrl.estimation.solver.levenberg_marquardt import Solver, relative_path
from dmrl.estimation.solver.priors import ConstantPrior
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Rows, Values

Complex = NDArray[np.complex128]
CALM_WINDOW_S = 20.0
"""Window of the transform, seconds: a slow robot keeps its velocity for a part of it."""
MAX_MOTION_HZ = 1.0
"""Highest frequency of motion, Hz. Robots do not change their velocity faster."""
MIN_ENERGY_RATIO = 2.5
"""Motion must exceed the energy of its noise by this factor. The mean of three bins of pure noise,
chi-square with six degrees of freedom, exceeds it in 2 % of all cases."""
MIN_MOTION_ENERGY = 1.0
"""Smallest energy of a motion that makes the bearing observable, relative to that of the odometry
noise over a second: 0.06 m/s with the default noise, 0.04 m/s with calibrated sensors."""


class Covariances(NamedTuple):
    """Covariances of a solution.

    Parameters
    ----------
    keyframes, constants
        (K, n, n) of the keyframes and (G, G) of the constants.
    calm
        (K, n) states at which the equations are linearized.
    """

    keyframes: Array
    constants: Array
    calm: Array

    def relative(self, state: Array, one: int = 0, other: int = 1) -> Array:
        """Return (K, 3, 3) covariances of one robot's pose in another's horizontal frame.

        Parameters
        ----------
        state
            (K, n) states of the solution.
        one, other
            Observer and peer.
        """
        linearized_m, seen_m = (relative_path(s, one, other)[:, :2] for s in (self.calm, state))
        back = rotation_matrix(-self.calm[:, 3 * one + 2])
        by_both = np.zeros((len(state), 3, 6))
        by_both[:, :2, :2], by_both[:, :2, 3:5] = -back, back
        by_both[:, :2, 2] = -linearized_m @ QUARTER_TURN.T
        by_both[:, 2, 2], by_both[:, 2, 5] = -1.0, 1.0
        bearing, calm_bearing = (np.arctan2(xy[:, 1], xy[:, 0]) for xy in (seen_m, linearized_m))
        by_both[:, :2] = rotation_matrix(bearing - calm_bearing) @ by_both[:, :2]
        at = np.concatenate([3 * one + np.arange(3), 3 * other + np.arange(3)])
        spread = self.keyframes[:, at[:, None], at]
        return np.asarray(by_both @ spread @ by_both.swapaxes(1, 2))


def compute_covariance(solver: Solver, values: Values) -> Covariances:
    """Compute the covariances of a solution."""
    layout = solver.layout
    calm = Values(calm_motion(solver.problem, values.state), values.constants)
    factors = []
    pairs = zip(solver.linearize(calm, layout), solver.linearize(values, layout), strict=True)
    for at_calm, at_solution in pairs:
        if isinstance(at_calm, Rows) and isinstance(at_solution, Rows):
            # The calm copy does not fit the measurements: weights come from the solution.
            at_calm = at_calm.with_residuals_of(at_solution)
        factors.append(at_calm)
    equations = build_equations(layout, factors, len(calm.state))
    for factor in factors:
        if isinstance(factor, ConstantPrior):
            held = factor.curvature() - factor.information()
            equations.globals_block[...] += np.diag(held)
    solved = solve_step(equations)
    spread = marginal_covariances(equations.diagonal, equations.off_diagonal)
    response = solved.response()
    by_constants = response @ solved.covariance @ response.swapaxes(1, 2)
    return Covariances(spread + by_constants, solved.covariance, calm.state)


def calm_motion(problem: Problem, state: Array) -> Array:
    """Return the states on paths without probable noise, own and relative.

    Parameters
    ----------
    problem
        Flight and its noise model.
    state
        (K, n) states of the solution.
    """
    robots, steps_s = len(problem.robots), np.diff(problem.keyframe_s)[:, None]
    step_s = float(np.median(steps_s))
    xy = np.stack([state[:, 3 * k] + 1j * state[:, 3 * k + 1] for k in range(robots)], axis=1)
    velocity = np.diff(xy, axis=0) / steps_s
    own = np.stack([_drop_noise(v, v, problem, step_s) for v in velocity.T], axis=1)
    mean = own.mean(axis=1, keepdims=True)
    # Two robots that move alike do not move relative to each other.
    pairs = zip((own - mean).T, velocity.T, strict=True)
    apart = np.stack([_drop_noise(v, raw, problem, step_s) for v, raw in pairs], axis=1)
    path = np.concatenate([np.zeros((1, robots)), np.cumsum((mean + apart) * steps_s, axis=0)])
    path += xy.mean(axis=0) - path.mean(axis=0)
    out = state.copy()
    for k in range(robots):
        out[:, 3 * k], out[:, 3 * k + 1] = path[:, k].real, path[:, k].imag
    return out


def odometry_energy(problem: Problem, robot: int) -> float:
    """Return the energy of a robot's own motion without noise, relative to the noise in a second.

    It is that of the measured motion: ranges to a peer would bend a solved one.
    """
    motion, step_s = problem.robots[robot].motion, problem.robots[robot].steps_s
    heading = np.concatenate([[0.0], np.cumsum(motion.turn_rad)])[:-1]
    shift = (motion.shift_m[:, 0] + 1j * motion.shift_m[:, 1]) * np.exp(1j * heading)
    velocity: Complex = np.asarray(shift / step_s, complex)
    calm = _drop_noise(velocity, velocity, problem, float(np.median(step_s)))
    return float((np.abs(calm) ** 2).mean() / problem.velocity_psd)


def _drop_noise(velocity: Complex, raw: Complex, problem: Problem, step_s: float) -> Complex:
    """Return a complex velocity (S,) with the frequencies that exceed their noise.

    Parameters
    ----------
    velocity, raw
        (S,) x + i y to clean; and as solved, which shows the noise above all motion, m/s.
    problem
        Flight with its noise model.
    step_s
        Seconds between samples.
    """
    length = min(2 * round(CALM_WINDOW_S / step_s / 2), 2 * (len(velocity) // 2))
    if length < 4:
        return velocity * 0
    hop = length // 2
    window = np.sin((np.arange(length) + 0.5) * np.pi / length)
    hz: Array = np.asarray(np.fft.fftfreq(length, step_s), float)
    found = _transform(velocity, window, hop)
    energy = np.abs(found) ** 2
    energy = (energy + np.roll(energy, 1, axis=1) + np.roll(energy, -1, axis=1)) / 3
    noise = 2 * (window**2).sum() / step_s * _noise_density(problem, hz, step_s)
    above = np.abs(hz) > MAX_MOTION_HZ
    # A flight without motion shows no grade of its noise, but no robot moves at twice this limit.
    beyond = np.abs(hz) > 2 * MAX_MOTION_HZ
    if beyond.any():
        shown = (np.abs(_transform(raw, window, hop)[:, beyond]) ** 2).mean(axis=1).min()
        louder = max(1.0, float(shown / noise[beyond].mean()))
    else:
        louder = 1.0
    bias_mps = next((row.std for row in problem.table if row.name == "vx_bias"), 0.0)
    noise[[-1, 0, 1]] += 2 * (window.sum() * bias_mps) ** 2 / 3
    # The energies of motion and noise add up to the measured one, so motion's share is the rest.
    share = np.sqrt(np.maximum(1 - noise / np.maximum(energy, 1e-12), 0.0))
    share[(energy < MIN_ENERGY_RATIO * louder * noise) | above] = 0.0
    calm = np.fft.ifft(found * share, axis=1) * window
    out = np.zeros(hop * (len(calm) + 1), complex)
    for number, piece in enumerate(calm):
        out[number * hop : number * hop + length] += piece
    return out[hop : hop + len(velocity)]


def _transform(velocity: Complex, window: Array, hop: int) -> Complex:
    """Return (W, length) Fourier transforms of overlapping windows of a velocity."""
    ends = (hop, len(window) + hop)
    long = len(velocity) > len(window) + hop
    padded = np.pad(velocity, ends, mode="reflect") if long else np.pad(velocity, ends, "wrap")
    starts = np.arange(0, len(padded) - len(window) + 1, hop)
    return np.asarray(np.fft.fft(padded[starts[:, None] + np.arange(len(window))] * window, axis=1))


def _noise_density(problem: Problem, hz: Array, step_s: float) -> Array:
    """Return (length,) noise of one axis of a velocity at each frequency, m^2/s."""
    white = problem.noise.velocity_psd * problem.noise.grade**2
    tau_s = max((r.time_s for r in problem.table if r.name == "velocity_error_x"), default=0.0)
    fading = problem.fading_psd / (1 + (2 * np.pi * hz * tau_s) ** 2)
    return np.asarray((white + fading) * np.sinc(hz * step_s) ** 2)
