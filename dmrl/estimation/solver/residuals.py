"""Residuals of a flight and their analytic Jacobians, by keyframe state and by constant.

A keyframe state is (x, y, psi, wx, wy, b). w is the error of the measured relative velocity in the
observer's frame, which decays with its correlation time. White noise in its place would discard
half of the information of the ranges. b is the temporary excess of the ranges: an obstacle
lengthens ranges for seconds.

With s the velocity scales, the process residual is divided by 1 / (1 + s). Without that division a
scale that shrinks the path would also shrink its noise and always reduce the cost.
"""

from dataclasses import dataclass

import numpy as np

from dmrl.estimation.model.odometry import QUARTER_TURN, rotation_matrix
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.camera_residuals import CameraResiduals, linearize_camera
from dmrl.estimation.solver.keyframes import GLOBALS, KeyframeProblem, NoiseModel

RANGE_BIAS, RANGE_SCALE, OWN_GYRO, PEER_GYRO, OWN_SCALE, PEER_SCALE = range(6)
"""Index among ``GLOBALS`` of offset and scale of the ranges, biases of the yaw rates, scales of the
velocities."""
STATE_SIZE = 6
"""Number of states of a keyframe."""
RANGE_STATES = [0, 1, 2, 5]
"""Index of the states on which a range depends."""
RANGE_ERROR = 5
"""Index of the range error b among the states, and among the residuals of a step."""
SCALED_RESIDUALS = [0, 1, 3, 4]
"""Index of the residuals of a step that the velocity scales divide."""
OWN_VELOCITY, PEER_VELOCITY, CLOCK = slice(6, 8), slice(8, 10), 10
"""Index among ``GLOBALS`` of the velocity biases and of the peer's clock offset."""
OBSERVER_CONSTANTS = [OWN_GYRO, OWN_SCALE, 6, 7]
"""Index among ``GLOBALS`` of the observer's own constants; `GLOBALS_FROM_PEER` maps them to the
peer's."""


@dataclass(frozen=True, slots=True)
class Linearization:
    """Whitened residuals and Jacobians at one solution. K keyframes, R ranges, G constants.

    Each Jacobian is stored beside its residuals in one array, so that one multiplication computes
    all products of a row.

    Parameters
    ----------
    steps
        (K - 1, 6, 6 + 6 + G + 1) rows of x, y, psi, wx, wy, b between neighbouring keyframes:
        Jacobians by the first keyframe, by the second, by the constants; residual.
    ranges
        (R, 4 + 2 + 1) Jacobians by x, y, psi, b and by offset and scale of the ranges; residual.
    error_m
        (K,) b, metres.
    camera
        Residuals of the cameras. None: no images.
    """

    steps: Array
    ranges: Array
    error_m: Array
    camera: CameraResiduals | None = None

    @property
    def step(self) -> Array:
        """(K - 1, 6) residuals of the steps."""
        return self.steps[..., -1]

    @property
    def range(self) -> Array:
        """(R,) residuals of the ranges."""
        return self.ranges[:, -1]


def linearize(
    problem: KeyframeProblem, noise: NoiseModel, state: Array, constants: Array
) -> Linearization:
    """Compute residuals and Jacobians at a solution.

    Parameters
    ----------
    problem, noise
        Keyframes of the flight, and the noise model.
    state
        (K, 6) x, y (m), psi (rad), wx, wy (m/s), b (m).
    constants
        (G,) in the order of ``GLOBALS``.
    """
    steps = _step_rows(problem, noise, state, constants)
    ranges = _range_rows(problem, noise, state, constants)
    looked = None if problem.camera is None else linearize_camera(problem.camera, state)
    return Linearization(steps, ranges, state[:, RANGE_ERROR], looked)


@dataclass(frozen=True, slots=True)
class _Propagation:
    """Propagation of a solution from each keyframe to the next. S = K - 1 steps.

    ``own_gain`` and ``peer_gain`` are 1 / (1 + scale) of either velocity. ``own`` and ``peer`` (S,
    2) are the corrected shifts, ``own_turn`` and ``peer_turn`` (S,) the corrected turns.
    ``heading`` and ``turned`` (S, 2, 2) rotate by the peer's heading and by the observer's turn.
    ``ahead`` and ``error_ahead`` (S, 2) are position and velocity error of the next keyframe in the
    frame of this one. ``half_s`` (S, 1) is half the step. ``kept`` and ``range_kept`` (S, 1) are
    the factors by which a velocity error and a range error decay over the step.
    """

    own_gain: float
    peer_gain: float
    own: Array
    peer: Array
    own_turn: Array
    peer_turn: Array
    heading: Array
    turned: Array
    ahead: Array
    error_ahead: Array
    half_s: Array
    kept: Array
    range_kept: Array


def _propagate(
    problem: KeyframeProblem, noise: NoiseModel, state: Array, constants: Array
) -> _Propagation:
    """Propagate the states by the measured motion, corrected by the constants."""
    steps_s = problem.steps_s
    own_gain, peer_gain = 1 / (1 + constants[[OWN_SCALE, PEER_SCALE]])
    clock = problem.peer_clock_derivative * constants[CLOCK]
    biased = problem.peer.bias_jacobian_s @ constants[PEER_VELOCITY]
    heading = rotation_matrix(state[:-1, 2])
    own_turn = problem.own.turn_rad - constants[OWN_GYRO] * steps_s
    turned = rotation_matrix(own_turn)
    return _Propagation(
        own_gain,
        peer_gain,
        own=own_gain
        * (problem.own.shift_m - problem.own.bias_jacobian_s @ constants[OWN_VELOCITY]),
        peer=_multiply_pairwise(heading, peer_gain * (problem.peer.shift_m + clock - biased)),
        own_turn=own_turn,
        peer_turn=problem.peer.turn_rad - constants[PEER_GYRO] * steps_s,
        heading=heading,
        turned=turned,
        ahead=_multiply_pairwise(turned, state[1:, :2]),
        error_ahead=_multiply_pairwise(turned, state[1:, 3:5]),
        half_s=steps_s[:, None] / 2,
        kept=np.exp(-steps_s / noise.velocity_tau_s)[:, None],
        range_kept=np.exp(-steps_s / noise.range_tau_s)[:, None],
    )


def _step_rows(
    problem: KeyframeProblem, noise: NoiseModel, state: Array, constants: Array
) -> Array:
    """Return (S, 6, 6 + 6 + G + 1) whitened rows of the steps."""
    moves = _propagate(problem, noise, state, constants)
    share = np.sqrt((moves.own_gain**2 + moves.peer_gain**2) / 2)
    weight = 1 / np.sqrt(step_variance(problem, noise))
    weight[:, SCALED_RESIDUALS] /= share
    out = np.zeros((len(moves.own), STATE_SIZE, 2 * STATE_SIZE + len(GLOBALS) + 1))
    by_start, by_end, by_globals = np.split(out[..., :-1], [STATE_SIZE, 2 * STATE_SIZE], axis=2)
    out[..., -1] = _step_residuals(moves, state)
    _fill_state_jacobians(moves, by_start, by_end)
    _fill_global_jacobians(moves, problem, by_globals)
    out *= weight[:, :, None]
    # The whitening itself depends on the scales.
    for column, gain in ((OWN_SCALE, moves.own_gain), (PEER_SCALE, moves.peer_gain)):
        by_globals[:, SCALED_RESIDUALS, column] += (
            out[:, SCALED_RESIDUALS, -1] * gain**3 / (2 * share**2)
        )
    return out


def _step_residuals(moves: _Propagation, state: Array) -> Array:
    """Return (S, 6) residuals of the steps before whitening."""
    error = state[:-1, 3:5]
    # Relative motion in the observer's frame: p' = p + peer's shift - own shift + half_s (w + w'),
    # with the velocity error by the trapezoidal rule. psi: the peer's heading minus the observer's.
    shift = moves.ahead - state[:-1, :2] - moves.peer + moves.own
    shift = shift - moves.half_s * (error + moves.error_ahead)
    turn = state[1:, 2] - state[:-1, 2] - moves.peer_turn + moves.own_turn
    # Gauss-Markov process: an error decays over a step; the residual is the new noise.
    longer = state[1:, RANGE_ERROR:] - moves.range_kept * state[:-1, RANGE_ERROR:]
    return np.column_stack([shift, turn, moves.error_ahead - moves.kept * error, longer])


def _fill_state_jacobians(moves: _Propagation, by_start: Array, by_end: Array) -> None:
    """Fill (S, 6, 6) zeros each with the Jacobians by both keyframes."""
    by_start[:] = np.diag([-1.0, -1.0, -1.0, 0.0, 0.0, 0.0])
    by_start[:, :2, 2] = -moves.peer @ QUARTER_TURN.T
    by_start[:, [0, 1], [3, 4]], by_start[:, [3, 4], [3, 4]] = -moves.half_s, -moves.kept
    by_start[:, RANGE_ERROR, RANGE_ERROR] = -moves.range_kept[:, 0]
    by_end[:, :2, :2] = by_end[:, 3:5, 3:5] = moves.turned
    by_end[:, :2, 3:5] = -moves.half_s[:, None] * moves.turned
    by_end[:, 2, 2] = by_end[:, RANGE_ERROR, RANGE_ERROR] = 1.0


def _fill_global_jacobians(moves: _Propagation, problem: KeyframeProblem, out: Array) -> None:
    """Fill (S, 6, G) zeros with the Jacobian by the constants."""
    steps_s, heading = problem.steps_s, moves.heading
    moved = moves.ahead - moves.half_s * moves.error_ahead
    out[:, :2, OWN_GYRO] = -steps_s[:, None] * (moved @ QUARTER_TURN.T)
    out[:, 3:5, OWN_GYRO] = -steps_s[:, None] * (moves.error_ahead @ QUARTER_TURN.T)
    out[:, 2, OWN_GYRO], out[:, 2, PEER_GYRO] = -steps_s, steps_s
    out[:, :2, OWN_SCALE] = -moves.own_gain * moves.own
    out[:, :2, PEER_SCALE] = moves.peer_gain * moves.peer
    out[:, :2, OWN_VELOCITY] = -moves.own_gain * problem.own.bias_jacobian_s
    out[:, :2, PEER_VELOCITY] = moves.peer_gain * (heading @ problem.peer.bias_jacobian_s)
    out[:, :2, CLOCK] = -moves.peer_gain * _multiply_pairwise(
        heading, problem.peer_clock_derivative
    )


def step_variance(problem: KeyframeProblem, noise: NoiseModel) -> Array:
    """Return (K - 1, 6) variances of the residuals of each step, before whitening."""
    steps_s = problem.steps_s
    shift = 2 * noise.velocity_white_psd * steps_s + noise.dropout_speed_mps**2 * problem.dropout_s
    turn = 2 * noise.yaw_rate_psd * steps_s + noise.dropout_turn_radps**2 * problem.dropout_s
    faded = 1 - np.exp(-2 * steps_s / noise.velocity_tau_s)
    error = 2 * noise.velocity_std_mps**2 * faded
    longer = noise.range_error_std_m**2 * (1 - np.exp(-2 * steps_s / noise.range_tau_s))
    return np.column_stack([shift, shift, turn, error, error, longer])


def _range_rows(
    problem: KeyframeProblem, noise: NoiseModel, state: Array, constants: Array
) -> Array:
    """Return (R, 4 + 2 + 1) whitened rows of the ranges."""
    at = state[problem.range_keyframe]
    peer = _multiply_pairwise(
        rotation_matrix(state[:, 2])[problem.range_keyframe], problem.peer_to_range.shift_m
    )
    offset = at[:, :2] + peer - problem.own_to_range.shift_m
    distance = np.sqrt((offset**2).sum(axis=1) + problem.height_m**2) + 1e-6
    towards = offset / distance[:, None]
    gain = 1 + constants[RANGE_SCALE]
    out = np.empty((len(at), 7))
    out[:, :2] = -gain * towards
    out[:, 2] = gain * (towards[:, 0] * peer[:, 1] - towards[:, 1] * peer[:, 0])
    out[:, 3] = -1.0
    out[:, 4 + RANGE_BIAS], out[:, 4 + RANGE_SCALE] = -1.0, -distance
    out[:, -1] = problem.range_m - gain * distance - constants[RANGE_BIAS] - at[:, RANGE_ERROR]
    return out / noise.range_std_m


def _multiply_pairwise(matrices: Array, vectors: Array) -> Array:
    return matrices[..., 0] * vectors[:, :1] + matrices[..., 1] * vectors[:, 1:]
