"""The published extended Kalman filter, compared with the publication and with derivatives."""

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from dmrl.estimation.filters.ekf import (
    PRESETS,
    Steps,
    build_steps,
    filter_pair,
    input_variance,
    predict_range,
    propagate_state,
)
from dmrl.estimation.model.pair import Pair, SensorTrack

from ..flights import build_pair, simulate_flight


def build_ekf_steps(seed: int, preset: str) -> Steps:
    """Return the filter steps of a simulated flight of 8 s."""
    return build_steps(
        build_pair(simulate_flight("in_view", "realistic", seed, 8.0)), PRESETS[preset]
    )


def test_filterpy_needs_a_one_dimensional_state() -> None:
    ekf = ExtendedKalmanFilter(dim_x=3, dim_z=1)
    assert ekf.x.shape == (3, 1)  # this default and a flat gain would broadcast to (3, 3)
    state, _ = filter_pair(build_ekf_steps(1000, "published-sim"), PRESETS["published-sim"])
    assert state.shape[1:] == (3,)


def test_a_range_is_an_update_after_the_prediction() -> None:
    preset = PRESETS["published-sim"]
    steps = Steps(np.ones((1, 6)), np.zeros(1), np.array([0.5]), 0.1)
    state, covariance = filter_pair(steps, preset)
    ahead, by_state, by_input = propagate_state(np.zeros(3), steps.inputs[0], 0.1)
    prior = by_state @ np.diag(preset.initial_var) @ by_state.T
    prior += by_input @ input_variance(preset) @ by_input.T
    expected, row = predict_range(ahead, 0.0)
    gain = prior @ row.T / (row @ prior @ row.T + preset.range_std_m**2)
    assert state[0] == pytest.approx(ahead + gain @ (0.5 - expected))
    assert covariance[0] == pytest.approx((np.eye(3) - gain @ row) @ prior)


def test_the_published_filter_starts_at_zero_and_first_predicts() -> None:
    steps = build_ekf_steps(1000, "published-sim")
    silent = Steps(steps.inputs, steps.height_m, steps.range_m * np.nan, steps.dt_s)
    state, _ = filter_pair(silent, PRESETS["published-sim"])
    expected, _, _ = propagate_state(np.zeros(3), steps.inputs[0], steps.dt_s)
    assert np.allclose(state[0], expected)


def test_ekf_jacobians_equal_finite_differences() -> None:
    rng = np.random.default_rng(0)
    step = 1e-6
    for _ in range(5):
        state, inputs = rng.normal(size=3), rng.normal(size=6)
        _, by_state, by_input = propagate_state(state, inputs, 0.01)
        for column, change in enumerate(step * np.eye(3)):
            ahead, behind = (propagate_state(state + s * change, inputs, 0.01)[0] for s in (1, -1))
            assert np.allclose((ahead - behind) / (2 * step), by_state[:, column], atol=1e-8)
            ahead, behind = (predict_range(state + s * change, 1.0)[0] for s in (1, -1))
            row = predict_range(state, 1.0)[1][:, column]
            assert np.allclose((ahead - behind) / (2 * step), row, atol=1e-3)
        for column, change in enumerate(step * np.eye(6)):
            ahead, behind = (propagate_state(state, inputs + s * change, 0.01)[0] for s in (1, -1))
            assert np.allclose((ahead - behind) / (2 * step), by_input[:, column], atol=1e-8)


def test_the_simulation_preset_ignores_heights() -> None:
    assert not build_ekf_steps(1000, "published-sim").height_m.any()
    assert build_ekf_steps(1000, "published-firmware").height_m.any()


def test_predicted_range_is_three_dimensional() -> None:
    range_m, by_state = predict_range(np.array([3.0, 4.0, 0.7]), 12.0)
    assert range_m == pytest.approx([13.0], abs=1e-3)
    assert by_state[0] == pytest.approx([3 / 13, 4 / 13, 0.0], abs=1e-3)
    assert predict_range(np.array([0.0, 0.0, 0.1]), -2.0)[0] == pytest.approx([2.0], abs=1e-3)


def test_ekf_steps_hold_inputs_and_ranges_go_to_the_nearest_step() -> None:
    time_s = 7 + np.arange(50) / 100
    own, peer = (
        SensorTrack(*(k + 10 * n + 0.01 * np.arange(50) for k in range(4)), np.zeros(50, bool))
        for n in (1, 2)
    )
    pair = Pair(time_s, own, peer, np.array([7.004, 7.006, 7.012, 7.49]), np.array([1.0, 2, 3, 4]))
    steps = build_steps(pair, PRESETS["published-firmware"])
    assert steps.dt_s == pytest.approx(0.01)
    assert steps.height_m == pytest.approx(peer.height_m - own.height_m)
    columns = [peer.vx_mps, peer.vy_mps, peer.yaw_rate_radps]
    columns += [own.vx_mps, own.vy_mps, own.yaw_rate_radps]
    assert steps.inputs == pytest.approx(np.column_stack(columns))
    heard = {0: 1.0, 1: 3.0, 49: 4.0}  # a step keeps the last of its ranges
    for k, range_m in enumerate(steps.range_m):
        assert range_m == heard[k] if k in heard else np.isnan(range_m)


def test_input_covariance_has_velocity_and_yaw_rate_variances() -> None:
    preset = PRESETS["published-firmware"]
    v, r = preset.velocity_var, preset.yaw_rate_var
    assert v != r
    assert np.diag(input_variance(preset)).tolist() == [v, v, r, v, v, r]
    assert np.count_nonzero(input_variance(preset)) == 6


def test_presets_are_the_published_noise() -> None:
    sim, firmware = PRESETS["published-sim"], PRESETS["published-firmware"]
    assert (sim.velocity_var, sim.yaw_rate_var) == pytest.approx((0.0625, 0.16))
    assert (sim.range_std_m, sim.initial_var, sim.use_height) == (0.1, (10, 10, 0.1), False)
    assert (firmware.velocity_var, firmware.yaw_rate_var, firmware.range_std_m) == (1.0, 0.7, 2.0)
    assert (firmware.initial_var, firmware.use_height) == ((1000, 1000, 1), True)
