"""Faults of logged signals: spikes, dropouts, frozen and saturated values."""

import numpy as np
import pytest

from dmrl.estimation.signals.sensor_tracks import (
    build_track,
    find_frozen,
    find_saturated,
    find_spikes,
)

GRID_S = np.arange(0, 20, 0.01)


def draw_noise() -> np.ndarray:
    """Draw noise (N, 2) on the grid with a standard deviation of 0.1."""
    return np.random.default_rng(0).normal(0, 0.1, (len(GRID_S), 2))


def test_only_rare_outliers_are_spikes() -> None:
    turn = 0.5 * np.sin(2 * GRID_S) + draw_noise()[:, 0] / 5
    turn[700] += 3.0
    assert np.flatnonzero(find_spikes(turn)).tolist() == [700]
    assert find_spikes(np.degrees(turn)).sum() < 3
    assert not find_spikes(np.zeros(0)).any()


def test_zero_optical_flow_is_a_dropout() -> None:
    velocity = draw_noise()
    stuck = (GRID_S > 5) & (GRID_S < 9)
    velocity[stuck] = 0.0
    height = np.ones((len(GRID_S), 1))
    found = build_track((GRID_S, height), (GRID_S, velocity), (GRID_S, height), GRID_S)
    assert (found.dropout == stuck).mean() > 0.99


def test_upsampled_and_constant_zero_logs_are_not_frozen() -> None:
    slow = np.repeat(draw_noise()[::20], 20, axis=0)
    assert not find_frozen(GRID_S, slow, GRID_S).any()
    assert not find_frozen(GRID_S, np.zeros((len(GRID_S), 2)), GRID_S).any()


def test_track_columns_match_sensors_and_dropouts_are_marked() -> None:
    forward = draw_noise() * 0.01 + [1.0, -0.5]
    turn = np.full((len(GRID_S), 1), 0.3)
    high = np.ones((len(GRID_S), 1))
    every = (GRID_S, turn), (GRID_S, forward), (GRID_S, high)
    found = build_track(*every, GRID_S)
    assert found.vx_mps.mean() == pytest.approx(1.0, abs=0.01)
    assert found.vy_mps.mean() == pytest.approx(-0.5, abs=0.01)
    assert (found.yaw_rate_radps.mean(), found.height_m.mean()) == pytest.approx((0.3, 1.0))
    assert not found.dropout.any()
    heard = (GRID_S < 8) | (GRID_S > 9)
    for silent, names in ((0, "dropout"), (1, "dropout"), (2, "height_dropout")):
        logs = [(s[heard], v[heard]) if k == silent else (s, v) for k, (s, v) in enumerate(every)]
        found = build_track(*logs, GRID_S)
        assert (getattr(found, names) == ~heard).mean() > 0.99
        assert not (found.dropout.any() and silent == 2)


@pytest.mark.parametrize(("lasts_s", "stuck"), [(0.49, False), (0.52, True)])
def test_silence_is_longer_than_half_a_second(lasts_s: float, stuck: bool) -> None:
    values = draw_noise()
    values[500 : 500 + round(100 * lasts_s) + 1] = values[500]
    found = find_frozen(GRID_S, values, GRID_S)
    assert found.any() == stuck
    if stuck:
        assert GRID_S[found][[0, -1]] == pytest.approx([5.0, 5.0 + lasts_s])


@pytest.mark.parametrize(("share", "told"), [(0.48, True), (0.52, False)])
def test_signal_with_mostly_repeated_samples_is_not_frozen(share: float, told: bool) -> None:
    values = draw_noise()
    values[: round(share * len(values))] = 1.0
    assert find_frozen(GRID_S, values, GRID_S).any() == told


def test_heights_are_smoothed_by_local_parabolas() -> None:
    high = 1 + 0.3 * GRID_S - 0.02 * GRID_S**2
    still = np.zeros((len(GRID_S), 1))
    logs = (GRID_S, still), (GRID_S, draw_noise())
    inner = slice(30, -30)
    found = build_track(*logs, (GRID_S, high[:, None]), GRID_S).height_m
    assert found[inner] == pytest.approx(high[inner])
    spike = np.ones(len(GRID_S))
    spike[1000] += 0.01
    reach = np.flatnonzero(
        np.abs(build_track(*logs, (GRID_S, spike[:, None]), GRID_S).height_m - 1) > 1e-9
    )
    assert (reach.min(), reach.max()) == (975, 1025)


@pytest.mark.parametrize(("limit", "share"), [(0.8, 0.25), (10.0, 0.0)])
def test_signal_that_stays_at_its_limit_is_saturated(limit: float, share: float) -> None:
    rng = np.random.default_rng(3)
    true = np.sin(np.arange(4000) / 100) + rng.normal(0, 0.02, 4000)
    values = np.clip(true, -limit, limit)
    found = find_saturated(values)
    assert found.mean() == pytest.approx(2 * share * 0.82, abs=0.06)
    assert (np.abs(values[found]) == limit).all()


def test_rounded_signals_and_short_logs_do_not_show_saturation() -> None:
    rounded = np.round(np.sin(np.arange(4000) / 100), 1)
    assert not find_saturated(rounded).any()
    assert not find_saturated(np.zeros(2)).any()
    assert not find_saturated(np.zeros(4000)).any()


def test_heights_at_1_hz_are_no_dropout() -> None:
    second = GRID_S[::100]
    turn = draw_noise()[:, :1]
    found = build_track((GRID_S, turn), (GRID_S, draw_noise()), (second, np.ones((20, 1))), GRID_S)
    assert found.height_dropout is not None and not found.height_dropout[:1800].any()
    gone = second != 9.0
    found = build_track(
        (GRID_S, turn), (GRID_S, draw_noise()), (second[gone], np.ones((19, 1))), GRID_S
    )
    assert found.height_dropout is not None and found.height_dropout[850:950].all()
