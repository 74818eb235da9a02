"""Kalman filter and RTS smoother of an Ornstein-Uhlenbeck process (1930)."""

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import Array


def smooth_ornstein_uhlenbeck(
    time_s: Array,
    std: Array,
    time_constant_s: float,
    rows: NDArray[np.intp],
    offset: Array,
    noise: Array,
) -> tuple[Array, Array]:
    """Smooth an Ornstein-Uhlenbeck error from sparse measurements.

    Parameters
    ----------
    time_s
        (N,) ascending, seconds.
    std
        (N,) standard deviation of the error.
    time_constant_s
        Time in which the error decays to 1/e, seconds.
    rows
        (M,) indices of the measured times, each once.
    offset, noise
        (M,) measurements of the error and their standard deviations.

    Returns
    -------
    error, variance : Array
        (N,) each. Measurements may share an error, so the variance never falls below that of one
        measurement. It never exceeds the prior.
    """
    fade = np.exp(-np.diff(time_s) / time_constant_s)
    measured, spread = np.full(len(std), np.nan), np.ones(len(std))
    measured[rows], spread[rows] = offset, noise**2
    mean, var, ahead = np.zeros(len(std)), np.ones(len(std)), np.ones(len(std))
    ahead_mean = mean.copy()
    for k in range(len(std)):  # in units of ``std``
        if k:
            ahead_mean[k] = fade[k - 1] * mean[k - 1]
            ahead[k] = fade[k - 1] ** 2 * var[k - 1] + 1 - fade[k - 1] ** 2
        mean[k], var[k] = ahead_mean[k], ahead[k]
        if np.isfinite(measured[k]):
            gain = ahead[k] * std[k] / (std[k] ** 2 * ahead[k] + spread[k])
            mean[k] += gain * (measured[k] - std[k] * ahead_mean[k])
            var[k] *= 1 - gain * std[k]
    for k in range(len(std) - 2, -1, -1):
        gain = fade[k] * var[k] / ahead[k + 1]
        mean[k] += gain * (mean[k + 1] - ahead_mean[k + 1])
        var[k] += gain**2 * (var[k + 1] - ahead[k + 1])
    least = np.median(noise) ** 2 if len(noise) else np.inf
    return std * mean, np.minimum(std**2 * var + least, std**2)
