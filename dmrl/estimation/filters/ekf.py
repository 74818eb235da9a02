"""Published relative EKF (Li et al. 2020), by filterpy.

State (x, y, psi); the inputs are both robots' velocities and yaw rates. The filter starts at (0, 0,
0), as published, which is why it can converge to a wrong position.
"""

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from dmrl.estimation.model.pair import Array, Pair

RANGE_MARGIN_M = 1e-4
"""Added to every range, metres. It avoids a division by zero at the start (0, 0), as in the
firmware."""


@dataclass(frozen=True, slots=True)
class Preset:
    """Noise of the published filter.

    Parameters
    ----------
    velocity_var, yaw_rate_var
        Variances of the inputs, (m/s)^2 and (rad/s)^2.
    range_std_m
        Standard deviation of a range, metres.
    initial_var
        Initial variances of x, y (m^2), psi (rad^2).
    use_height
        Whether the range contains the height difference.
    """

    velocity_var: float
    yaw_rate_var: float
    range_std_m: float
    initial_var: tuple[float, float, float]
    use_height: bool


PRESETS = {
    "published-sim": Preset(0.25**2, 0.4**2, 0.1, (10.0, 10.0, 0.1), use_height=False),
    "published-firmware": Preset(1.0, 0.7, 2.0, (1000.0, 1000.0, 1.0), use_height=True),
}
"""Noise of the publication's simulation and of its firmware."""


@dataclass(frozen=True, slots=True)
class Steps:
    """Inputs of a filter at K steps.

    Parameters
    ----------
    inputs
        (K, 6): vx, vy, yaw rate of the peer, then of the observer.
    height_m
        (K,) peer's height minus the observer's, metres.
    range_m
        (K,) range that arrived with the step, metres; NaN without one.
    dt_s
        Seconds per step.
    """

    inputs: Array
    height_m: Array
    range_m: Array
    dt_s: float


def build_steps(pair: Pair, preset: Preset) -> Steps:
    """Build the inputs of the filter for one pair.

    Ranges go to the nearest step. If several fall on one step, as where both robots range, the last
    counts.
    """
    own, peer = pair.own, pair.peer
    inputs = np.column_stack(
        [peer.vx_mps, peer.vy_mps, peer.yaw_rate_radps, own.vx_mps, own.vy_mps, own.yaw_rate_radps]
    )
    height_m = (peer.height_m - own.height_m) * preset.use_height
    range_m = np.full(len(pair.time_s), np.nan)
    nearest = np.rint((pair.range_time_s - pair.time_s[0]) / pair.dt_s).astype(int)
    range_m[nearest] = pair.range_m
    return Steps(inputs, height_m, range_m, pair.dt_s)


def propagate_state(state: Array, inputs: Array, dt_s: float) -> tuple[Array, Array, Array]:
    """Propagate a state by one step; return it with its Jacobians.

    Parameters
    ----------
    state
        (3,) x, y (m), psi (rad).
    inputs
        (6,) as in `Steps`.
    dt_s
        Seconds.

    Returns
    -------
    state : Array
        (3,).
    by_state : Array
        (3, 3) Jacobian by the state, at the state before the step.
    by_input : Array
        (3, 6) Jacobian by the inputs.
    """
    x, y, psi = state
    vxj, vyj, rj, vxi, vyi, ri = inputs
    c, s = np.cos(psi), np.sin(psi)
    there = np.array([c * vxj - s * vyj, s * vxj + c * vyj])
    rate = np.array([there[0] - vxi + ri * y, there[1] - vyi - ri * x, rj - ri])
    by_state = np.eye(3) + dt_s * np.array([[0, ri, -there[1]], [-ri, 0, there[0]], [0, 0, 0]])
    by_input = dt_s * np.array([[c, -s, 0, -1, 0, y], [s, c, 0, 0, -1, -x], [0, 0, 1, 0, 0, -1]])
    return state + dt_s * rate, by_state, by_input


def predict_range(state: Array, height_m: float) -> tuple[Array, Array]:
    """Return the predicted range (1,) of a state, metres, and its Jacobian (1, 3)."""
    x, y, _ = state
    range_m = np.sqrt(x**2 + y**2 + height_m**2) + RANGE_MARGIN_M
    return np.array([range_m]), np.array([[x / range_m, y / range_m, 0.0]])


def input_variance(preset: Preset) -> Array:
    """Return the (6, 6) covariance of the inputs."""
    v, r = preset.velocity_var, preset.yaw_rate_var
    return np.diag([v, v, r, v, v, r])


class RelativeEkf(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """Extended Kalman filter of filterpy with the relative motion as its prediction."""

    def __init__(self, preset: Preset, dt_s: float) -> None:
        super().__init__(dim_x=3, dim_z=1)
        # Flat: filterpy's default, a column, broadcasts to (3, 3) in the update.
        self.x = np.zeros(3)
        self.P = np.diag(preset.initial_var)
        self.R = np.array([[preset.range_std_m**2]])
        self._noise = input_variance(preset)
        self._dt_s = dt_s

    def predict_x(self, u: Array) -> None:
        """Propagate the state. filterpy's ``predict`` calls this before it moves the covariance."""
        self.x, self.F, by_input = propagate_state(self.x, u, self._dt_s)
        self.Q = by_input @ self._noise @ by_input.T


def filter_pair(steps: Steps, preset: Preset) -> tuple[Array, Array]:
    """Filter one pair; return states (K, 3) and covariances (K, 3, 3).

    It calls ``predict`` and then ``update``, because filterpy's ``predict_update`` evaluates the
    Jacobian of the range before the prediction.

    Parameters
    ----------
    steps
        Inputs of the pair.
    preset
        Noise and initial variances.
    """
    ekf = RelativeEkf(preset, steps.dt_s)
    states, covariances = np.empty((len(steps.inputs), 3)), np.empty((len(steps.inputs), 3, 3))
    rows = zip(steps.inputs, steps.height_m.tolist(), steps.range_m.tolist(), strict=True)
    for k, (inputs, height_m, range_m) in enumerate(rows):
        ekf.predict(inputs)
        if np.isfinite(range_m):
            ekf.update(
                np.array([range_m]),
                lambda x, height_m: predict_range(x, height_m)[1],
                lambda x, height_m: predict_range(x, height_m)[0],
                args=(height_m,),
                hx_args=(height_m,),
            )
        states[k], covariances[k] = ekf.x, ekf.P
    return states, covariances
