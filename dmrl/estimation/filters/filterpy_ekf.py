"""Published relative EKF by filterpy: the reference of `ekf`, and slower to run and to import."""

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from dmrl.estimation.filters.ekf import (
    Preset,
    Steps,
    input_variance,
    predict_range,
    propagate_state,
)
from dmrl.estimation.model.pair import Array


class _RelativeEkf(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """Extended Kalman filter of filterpy with the relative motion as its prediction."""

    def __init__(self, preset: Preset, dt_s: float) -> None:
        super().__init__(dim_x=3, dim_z=1)
        self.x = np.zeros(3)
        self.P = np.diag(preset.initial_var)
        self.R = np.array([[preset.range_std_m**2]])
        self._noise = input_variance(preset)
        self._dt_s = dt_s

    def predict_x(self, u: Array) -> None:
        """Propagate the state. filterpy's ``predict`` calls this before it moves the covariance."""
        state, by_state, by_input = propagate_state(self.x[None], u[None], self._dt_s)
        self.F = by_state[0]
        self.Q = by_input[0] @ self._noise @ by_input[0].T
        self.x = state[0]


def filter_reference(steps: Steps, preset: Preset) -> tuple[Array, Array]:
    """Filter one pair with filterpy; return states (K, 3) and covariances (K, 3, 3).

    It calls ``predict`` and then ``update``, because filterpy's ``predict_update`` evaluates the
    Jacobian of the range before the prediction.

    Parameters
    ----------
    steps
        Inputs of one pair (B = 1).
    preset
        Noise and initial variances.

    Raises
    ------
    AssertionError
        If filterpy turned the state into a column, as it does with a state of another shape.
    """
    ekf = _RelativeEkf(preset, steps.dt_s)
    states, covariances = np.empty((len(steps.inputs), 3)), np.empty((len(steps.inputs), 3, 3))
    for k, (inputs, height_m, range_m) in enumerate(
        zip(steps.inputs[:, 0], steps.height_m[:, 0], steps.range_m[:, 0], strict=True)
    ):
        ekf.predict(inputs)
        if np.isfinite(range_m):
            height = np.array([height_m])
            ekf.update(
                np.array([range_m]),
                lambda x, h: predict_range(x[None], h)[1],
                lambda x, h: predict_range(x[None], h)[0],
                args=(height,),
                hx_args=(height,),
            )
        assert ekf.x.shape == (3,), "filterpy changed the state's shape"
        states[k], covariances[k] = ekf.x, ekf.P
    return states, covariances
