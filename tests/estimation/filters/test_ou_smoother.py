"""An error that fades, beside a dense solve of the same."""

import numpy as np
import pytest

from dmrl.estimation.filters.ou_smoother import smooth_ornstein_uhlenbeck


def test_an_error_that_fades_is_that_of_a_dense_solve() -> None:
    rng, count = np.random.default_rng(6), 12
    time_s, std = np.cumsum(rng.uniform(0.1, 2.0, count)), rng.uniform(0.05, 0.3, count)
    rows = np.array([1, 2, 5, 11])
    off, noise = rng.normal(0, 0.2, 4), np.full(4, 0.04)
    mean, variance = smooth_ornstein_uhlenbeck(time_s, std, 4.0, rows, off, noise)
    alike = np.exp(-np.abs(np.subtract.outer(time_s, time_s)) / 4.0)
    prior = alike * np.outer(std, std)
    gain = prior[:, rows] @ np.linalg.inv(prior[np.ix_(rows, rows)] + noise**2 * np.eye(4))
    assert mean == pytest.approx(gain @ off)
    left = np.diag(prior - gain @ prior[rows])
    assert variance == pytest.approx(np.minimum(left + 0.04**2, std**2))


def test_measurements_that_may_share_an_error_tell_no_more_than_one() -> None:
    time_s, std = np.arange(200) * 0.05, np.full(200, 1.0)
    _, variance = smooth_ornstein_uhlenbeck(
        time_s, std, 4.0, np.arange(200), np.zeros(200), np.full(200, 0.1)
    )
    assert (variance > 0.1**2).all() and variance[100] < 2 * 0.1**2


def test_without_measurements_nothing_changes() -> None:
    none = np.zeros(0, np.intp), np.zeros(0), np.zeros(0)
    mean, variance = smooth_ornstein_uhlenbeck(np.arange(5.0), np.full(5, 0.2), 4.0, *none)
    assert not mean.any()
    assert variance == pytest.approx(np.full(5, 0.04))
