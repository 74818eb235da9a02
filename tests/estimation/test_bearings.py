"""Positions corrected by detections."""

import numpy as np
import pytest

from dmrl.estimation.bearings import (
    Array,
    Sharpness,
    _cartesian,
    _difference,
    _nearest,
    _polar,
    _smoothed,
    corrected,
)

SHARP = Sharpness()


def flight(
    rng: np.random.Generator, count: int = 400, lasting_rad: float = 0.12
) -> tuple[Array, Array, Array, Array]:
    """Times, true positions, estimates whose bearing wanders, and their covariance."""
    time_s = np.arange(count) * 0.1
    azimuth = 0.3 * np.sin(time_s / 7)
    truth = np.stack([1.2 * np.cos(azimuth), 1.2 * np.sin(azimuth), 0.1 + 0 * azimuth], axis=1)
    wander = np.zeros(count)
    fade = np.exp(-0.1 / SHARP.fade_s)
    for k in range(1, count):
        wander[k] = fade * wander[k - 1] + np.sqrt(1 - fade**2) * rng.standard_normal()
    angle = lasting_rad * wander
    c, s = np.cos(angle), np.sin(angle)
    turned = np.stack([c * truth[:, 0] - s * truth[:, 1], s * truth[:, 0] + c * truth[:, 1]], 1)
    across = np.stack([-truth[:, 1], truth[:, 0], 0 * angle], axis=1)
    covariance = lasting_rad**2 * across[:, :, None] * across[:, None] + 0.02**2 * np.eye(3)
    return time_s, truth, np.column_stack([turned, truth[:, 2]]), covariance


def detected(rng: np.random.Generator, truth: Array) -> Array:
    """Where a network sees the peer: bearing to 0.03 rad, distance to a quarter."""
    points = truth * np.exp(0.2 * rng.standard_normal((len(truth), 1)))
    return points + 0.03 * 1.2 * rng.standard_normal(truth.shape) * (0, 1, 1)


def off_m(xyz_m: Array, truth: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((xyz_m - truth) ** 2, axis=1))))


def test_detections_take_out_a_bearing_that_wanders() -> None:
    rng = np.random.default_rng(0)
    time_s, truth, believed, covariance = flight(rng)
    rows = np.arange(0, len(truth), 3)
    points = detected(rng, truth[rows])
    xyz_m, spread, used = corrected(time_s, believed, covariance, rows, points, SHARP)
    assert used > 0.9 * len(rows)
    assert off_m(xyz_m, truth) < 0.35 * off_m(believed, truth)
    # Distances were good already, and detections' poor ones leave them so.
    distance = [np.linalg.norm(p, axis=1) for p in (xyz_m, truth)]
    assert np.abs(distance[0] - distance[1]).max() < 0.03
    assert (np.linalg.eigvalsh(spread) > 0).all()
    assert (np.trace(spread, axis1=1, axis2=2) <= np.trace(covariance, axis1=1, axis2=2)).all()


def test_false_alarms_beyond_the_gate_change_nothing() -> None:
    rng = np.random.default_rng(1)
    time_s, truth, believed, covariance = flight(rng)
    rows = np.repeat(np.arange(0, len(truth), 5), 2)
    points = truth[rows] * [[1, -1, -4]] + [[0, 1.5, 0]]
    xyz_m, spread, used = corrected(time_s, believed, covariance, rows, points, SHARP)
    assert used == 0
    assert xyz_m is believed
    assert spread is covariance


def test_of_several_detections_the_one_that_fits_counts() -> None:
    rng = np.random.default_rng(2)
    time_s, truth, believed, covariance = flight(rng)
    here = np.arange(0, len(truth), 3)
    right = detected(rng, truth[here])
    alone = corrected(time_s, believed, covariance, here, right, SHARP)
    wrong = right * 1.0
    wrong[:, 1] += 1.0
    rows, points = np.repeat(here, 2), np.stack([wrong, right], axis=1).reshape(-1, 3)
    both = corrected(time_s, believed, covariance, rows, points, SHARP)
    assert both[2] == alone[2]
    assert both[0] == pytest.approx(alone[0])


def test_without_detections_nothing_changes() -> None:
    time_s, _, believed, covariance = flight(np.random.default_rng(3))
    none = np.zeros(0, np.int64)
    result = corrected(time_s, believed, covariance, none, np.zeros((0, 3)), SHARP)
    assert result[0] is believed
    assert result[2] == 0


def test_behind_the_observer_azimuths_are_compared_the_short_way() -> None:
    time_s = np.arange(50) * 0.1
    truth = np.tile([-1.0, 0.02, 0.0], (50, 1))
    believed = np.tile([-1.0, -0.05, 0.0], (50, 1))
    covariance = np.tile(np.diag([0.01, 0.01, 0.01]), (50, 1, 1))
    rows = np.arange(50)
    xyz_m, _, used = corrected(time_s, believed, covariance, rows, truth, SHARP)
    assert used == 50
    assert xyz_m[25] == pytest.approx(truth[25], abs=0.02)


def test_detections_that_share_an_error_tell_no_more_than_one() -> None:
    """However many there are; and where positions are surer, they stay as sure."""
    time_s = np.arange(200) * 0.05
    truth = np.tile([2.0, 0.0, 0.0], (200, 1))
    for std_m, azimuth in ((1.0, SHARP.bearing_std_rad), (0.01, 0.005)):
        covariance = np.tile(std_m**2 * np.eye(3), (200, 1, 1))
        _, spread, used = corrected(time_s, truth, covariance, np.arange(200), truth, SHARP)
        assert used == 200
        sigma = np.sqrt(spread[100].diagonal()) / 2  # two metres away, of its distance
        assert sigma[1] >= azimuth * 0.999
        assert sigma[2] == pytest.approx(sigma[1]) and sigma[1] < 1.5 * azimuth
        assert sigma[0] >= min(SHARP.range_std_ratio, std_m / 2) * 0.999


def test_directions_and_places_turn_into_each_other_with_their_slopes() -> None:
    xyz = np.random.default_rng(3).normal(size=(20, 3))
    polar, turn = _polar(xyz)
    assert _cartesian(polar) == pytest.approx(xyz)
    assert polar[:, 2] == pytest.approx(np.log(np.linalg.norm(xyz, axis=1)))
    assert np.tan(polar[:, 0]) == pytest.approx(xyz[:, 1] / xyz[:, 0])
    assert np.sin(polar[:, 1]) == pytest.approx(xyz[:, 2] / np.linalg.norm(xyz, axis=1))
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        slope = _difference(_polar(xyz + step)[0], _polar(xyz - step)[0]) / 2e-6
        assert turn[:, :, k] == pytest.approx(slope, rel=1e-5, abs=1e-5)


def test_errors_that_fade_are_those_of_a_dense_solve() -> None:
    rng, count = np.random.default_rng(6), 12
    fade = rng.uniform(0.5, 0.99, count - 1)
    std = rng.uniform(0.05, 0.3, (count, 3))
    rows = np.array([1, 2, 5, 11])
    off, noise = rng.normal(0, 0.2, (4, 3)), np.array([0.03, 0.05, 0.25])
    mean, variance = _smoothed(fade, std, rows, off, noise)
    together = np.concatenate([[0.0], np.cumsum(np.log(fade))])
    alike = np.exp(-np.abs(np.subtract.outer(together, together)))
    for axis in range(3):
        prior = alike * np.outer(std[:, axis], std[:, axis])
        gain = prior[:, rows] @ np.linalg.inv(
            prior[np.ix_(rows, rows)] + noise[axis] ** 2 * np.eye(4)
        )
        assert mean[:, axis] == pytest.approx(gain @ off[:, axis])
        left = prior - gain @ prior[rows]
        assert variance[:, axis] == pytest.approx(np.diag(left))


def test_of_each_image_the_nearest_within_the_gate_is_chosen() -> None:
    rows, distance = np.array([0, 0, 1, 2, 2, 2]), np.array([2.0, 1.0, 12.0, 3.0, 3.5, 0.5])
    assert _nearest(rows, distance, 11.3).tolist() == [1, 5]
    assert _nearest(rows[:0], distance[:0], 11.3).tolist() == []
