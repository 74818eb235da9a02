"""Simulated noise matches the noise table."""

from dataclasses import fields
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from dmrl.flight import NOISE, Flight, Noise, Scenario, simulate
from dmrl.flight.sensors import draw_coloured_noise, draw_pair_errors
from dmrl.geometry.frames import Array

PRESETS = ["calibrated", "realistic", "harsh"]
FLIGHTS = 60


@cache
def simulate_ideal(scenario: Scenario, seed: int) -> Flight:
    """Simulate the same flight with ideal sensors, once for all presets."""
    return simulate(scenario, NOISE["ideal"], seed)


@pytest.fixture(scope="module", params=PRESETS)
def preset(request: pytest.FixtureRequest) -> tuple[Noise, list[tuple[Flight, Flight]]]:
    """Return a noise preset and sixty short flights, each with its twin with ideal sensors."""
    noise, scenario = NOISE[request.param], Scenario(robots=3, duration_s=15.0)
    pairs = [(simulate(scenario, noise, k), simulate_ideal(scenario, k)) for k in range(FLIGHTS)]
    return noise, pairs


def compute_errors(pairs: list[tuple[Flight, Flight]], name: str) -> Array:
    """Return (flights x robots, samples) errors of a column: measured minus ideal."""
    return np.array(
        [
            getattr(noisy.robots[r], name) - getattr(ideal.robots[r], name)
            for noisy, ideal in pairs
            for r in noisy.robots
        ]
    )


Preset = tuple[Noise, list[tuple[Flight, Flight]]]


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("column", "white", "bias"),
    [
        ("yaw_rate_radps", "yaw_rate_white_radps", "yaw_rate_bias_radps"),
        ("height_m", "height_white_m", "height_bias_m"),
        ("roll_rad", "attitude_white_rad", "attitude_bias_rad"),
        ("pitch_rad", "attitude_white_rad", "attitude_bias_rad"),
    ],
)
def test_white_noise_and_bias_match_the_noise_table(
    preset: Preset, column: str, white: str, bias: str
) -> None:
    noise, pairs = preset
    error = compute_errors(pairs, column)
    assert error.std(axis=1).mean() == pytest.approx(getattr(noise, white), rel=0.02)
    # With 180 draws the standard error of a standard deviation is 5 %.
    assert error.mean(axis=1).std() == pytest.approx(getattr(noise, bias), rel=0.2)


@pytest.mark.heavy
def test_velocity_noise_is_white_and_coloured(preset: Preset) -> None:
    noise, pairs = preset
    ideal = np.concatenate([[i.robots[r].vx_mps for r in i.robots] for _, i in pairs])
    error = compute_errors(pairs, "vx_mps")
    # In each flight, the part proportional to the true velocity is the scale; the mean is the bias.
    centred, moved = error - error.mean(axis=1, keepdims=True), ideal - ideal.mean(axis=1)[:, None]
    scale = (centred * moved).sum(axis=1) / (moved**2).sum(axis=1)
    rest = centred - scale[:, None] * moved
    far = noise.velocity_coloured_mps**2 * np.exp(-0.05 / 0.3)  # five samples apart
    assert (rest[:, 5:] * rest[:, :-5]).mean() == pytest.approx(far, rel=0.15)
    both = np.hypot(noise.velocity_white_mps, noise.velocity_coloured_mps)
    assert rest.std() == pytest.approx(both, rel=0.02)


@pytest.mark.heavy
@pytest.mark.parametrize("name", PRESETS)
def test_velocity_scale_and_bias_match_the_noise_table(name: str) -> None:
    preset = NOISE[name]
    constant = Noise(
        velocity_scale=preset.velocity_scale, velocity_bias_mps=preset.velocity_bias_mps
    )
    scenario, drawn = Scenario(robots=6, duration_s=3.0, trajectory="random"), []
    for seed in range(60):
        noisy, ideal = simulate(scenario, constant, seed), simulate_ideal(scenario, seed)
        for robot, log in noisy.robots.items():
            scale, bias = np.polyfit(ideal.robots[robot].vx_mps, log.vx_mps, 1)
            other, _ = np.polyfit(ideal.robots[robot].vy_mps, log.vy_mps, 1)
            assert other == pytest.approx(scale)  # both axes have the same scale
            drawn.append((scale, bias))
    scale, bias = np.array(drawn).T
    assert scale.std() == pytest.approx(preset.velocity_scale, rel=0.12)
    assert scale.mean() == pytest.approx(1.0, abs=0.02)
    assert bias.std() == pytest.approx(preset.velocity_bias_mps, rel=0.12)


@pytest.mark.heavy
def test_coloured_noise_is_stationary_with_exponential_correlation() -> None:
    made = np.array(
        [draw_coloured_noise(np.random.default_rng(k), 300, 0.1, 0.3) for k in range(800)]
    )
    assert made[:, 0].std() == pytest.approx(0.1, rel=0.08)
    assert made[:, -1].std() == pytest.approx(0.1, rel=0.08)
    fading = (made[:, 100] * made[:, 130]).mean() / 0.01
    assert fading == pytest.approx(np.exp(-1.0), abs=0.1)


def compute_range_errors(flight: Flight) -> Array:
    """Return the error of every range of a flight, metres."""
    found = []
    for (here, peer), ranges in flight.ranges.items():
        time_s = flight.clocks[here].to_true_time(ranges.time_s)
        away = flight.peer_in_horizontal(here, peer, time_s)
        found.append(ranges.range_m - np.linalg.norm(away, axis=1))
    return np.concatenate(found)


@pytest.mark.heavy
def test_range_noise_matches_the_noise_table(preset: Preset) -> None:
    noise, pairs = preset
    every, whites = [], []
    for noisy, _ in pairs:
        every.append(compute_range_errors(noisy))
        for (here, peer), ranges in noisy.ranges.items():
            time_s = noisy.clocks[here].to_true_time(ranges.time_s)
            true = np.linalg.norm(noisy.peer_in_horizontal(here, peer, time_s), axis=1)
            slope, offset = np.polyfit(true, ranges.range_m, 1)
            rest = ranges.range_m - slope * true - offset
            low = rest - np.median(rest)
            whites.append(np.sqrt(np.mean(low[low < 0] ** 2)))  # detours only make ranges longer
    assert np.mean(whites) == pytest.approx(noise.uwb_white_m, rel=0.15)
    mean = noise.nlos_share * noise.nlos_mean_m
    spread = 3 * noise.uwb_bias_m / np.sqrt(3 * FLIGHTS) + 0.01
    assert np.mean([e.mean() for e in every]) == pytest.approx(mean, abs=spread)


@pytest.mark.heavy
def test_share_of_lost_ranges_matches_the_noise_table(preset: Preset) -> None:
    noise, pairs = preset
    got = np.mean([[len(r.time_s) for r in noisy.ranges.values()] for noisy, _ in pairs])
    assert got / (15.0 * noise.ranging_rate_hz) == pytest.approx(1 - noise.ranging_loss, abs=0.01)


@pytest.mark.parametrize("name", PRESETS)
def test_pair_bias_and_scale_match_the_noise_table(name: str) -> None:
    noise = NOISE[name]
    drawn = np.array([draw_pair_errors(np.random.default_rng(k), noise) for k in range(2000)])
    assert drawn[:, 0].std() == pytest.approx(noise.uwb_bias_m, rel=0.06)
    assert drawn[:, 1].std() == pytest.approx(noise.uwb_scale, rel=0.06)
    assert drawn[:, 1].mean() == pytest.approx(1.0, abs=0.005)


def test_range_bias_is_equal_in_both_directions() -> None:
    noise = Noise(uwb_bias_m=0.3)
    flight = simulate(Scenario(duration_s=5.0), noise, 3)
    offsets = []
    for (here, peer), ranges in flight.ranges.items():
        true = np.linalg.norm(flight.peer_in_horizontal(here, peer, ranges.time_s), axis=1)
        offsets.append((ranges.range_m - true).mean())
    assert offsets[0] == pytest.approx(offsets[1], abs=1e-3)
    assert abs(offsets[0]) > 0.01


def test_ideal_sensors_have_no_noise() -> None:
    flight = simulate(Scenario(duration_s=5.0), NOISE["ideal"], 0)
    assert len(flight.ranges["cf1", "cf2"].time_s) == 250
    assert np.abs(compute_range_errors(flight)).max() < 1e-3


def test_presets_are_ordered_in_every_noise_parameter() -> None:
    names = [f.name for f in fields(Noise) if f.name not in ("ranging_rate_hz", "velocity_tau_s")]
    presets = [NOISE[name] for name in ("ideal", *PRESETS)]
    for better, worse in pairwise(presets):
        assert [n for n in names if getattr(worse, n) < getattr(better, n)] == []
