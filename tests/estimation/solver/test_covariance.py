"""Covariances of positions, for which noise is removed from the estimated motion."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.model.odometry import rotation_matrix
from dmrl.estimation.model.pair import Pair
from dmrl.estimation.solver import covariance
from dmrl.estimation.solver.covariance import (
    Covariances,
    calm_motion,
    compute_covariance,
)
from dmrl.estimation.solver.equations import build_equations
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.levenberg_marquardt import Solver, relative_path
from dmrl.estimation.solver.problem import NoiseModel, Problem

from ..sighted_flights import build_still_pair
from .test_residuals import build_flight

KEYS, STEP_S = 501, 0.2
KEY_S = np.arange(KEYS) * STEP_S


def build_still_problem(noise: NoiseModel | None = None) -> Problem:
    """Return the problem of two robots at rest for 100 s; its measurements do not matter."""
    time_s = np.arange(0, 100.001, 0.01)
    short, _ = build_still_pair()
    zero, never = np.zeros(len(time_s)), np.zeros(len(time_s), bool)
    still = replace(
        short.own, vx_mps=zero, vy_mps=zero, yaw_rate_radps=zero, height_m=zero, dropout=never
    )
    ranges_s = np.arange(0.05, 100, 1.0)
    pair = Pair(time_s, still, still, ranges_s, np.full(len(ranges_s), 2.0))
    return replace(build_problem({(0, 1): pair}), noise=noise or NoiseModel())


def build_states(task: Problem, *velocities: np.ndarray | complex) -> np.ndarray:
    """Return states of robots with complex velocities vx + i vy, (S,) or constant, m/s."""
    state = np.zeros((KEYS, task.layout.width))
    for robot, velocity in enumerate(velocities):
        steps = np.broadcast_to(velocity, KEYS - 1) * STEP_S
        path = robot + np.concatenate([[0], np.cumsum(steps)])
        state[:, 3 * robot], state[:, 3 * robot + 1] = path.real, path.imag
    return state


def measure_speeds(task: Problem, state: np.ndarray) -> list[float]:
    """Return the RMS of the denoised own velocity and of the relative velocity, m/s."""
    calm = calm_motion(task, state)
    own, peer = (calm[:, 3 * k] + 1j * calm[:, 3 * k + 1] for k in (0, 1))
    inner = slice(50, -50)
    return [
        float(np.sqrt((np.abs(np.diff(path) / STEP_S)[inner] ** 2).mean()))
        for path in (own, peer - own)
    ]


def draw_odometry_noise(task: Problem, rng: np.random.Generator) -> np.ndarray:
    """Draw velocity noise of the model, a correlated part with 0.3 s and a white one, m/s."""
    fading = 0.08 * task.noise.grade
    out, value = np.zeros(KEYS - 1, complex), 0j
    for k in range(10 * (KEYS - 1)):
        kept = np.exp(-0.02 / 0.3)
        draw = complex(*rng.normal(0, fading * np.sqrt(1 - kept**2), 2))
        value = kept * value + draw
        out[k // 10] += value / 10
    white = task.noise.grade * np.sqrt(task.noise.velocity_psd / STEP_S)
    return out + rng.normal(0, white, KEYS - 1) + 1j * rng.normal(0, white, KEYS - 1)


@pytest.mark.heavy
def test_denoising_removes_motion_that_is_noise() -> None:
    task, rng = build_still_problem(), np.random.default_rng(0)
    for _ in range(3):
        own, relative = measure_speeds(
            task, build_states(task, draw_odometry_noise(task, rng), draw_odometry_noise(task, rng))
        )
        raw = np.sqrt(2 * task.velocity_psd / STEP_S)
        assert own < 0.15 * raw and relative < 0.15 * raw


@pytest.mark.heavy
def test_denoising_keeps_fast_and_slow_motion() -> None:
    task = build_still_problem(NoiseModel(grade=0.63))
    rng = np.random.default_rng(1)
    for speed, period_s in ((0.5, 6.0), (0.12, 25.0)):
        way = speed * np.exp(2j * np.pi * KEY_S[1:] / period_s)
        own, relative = measure_speeds(
            task,
            build_states(
                task, way + draw_odometry_noise(task, rng), draw_odometry_noise(task, rng)
            ),
        )
        assert 0.5 * speed < own < 1.2 * speed
        assert 0.5 * speed < relative < 1.2 * speed


def test_equal_motions_have_no_relative_motion() -> None:
    task, rng = build_still_problem(), np.random.default_rng(2)
    way = 0.5 * np.exp(2j * np.pi * KEY_S[1:] / 6.0)
    own, relative = measure_speeds(
        task,
        build_states(
            task, way + draw_odometry_noise(task, rng), way + draw_odometry_noise(task, rng)
        ),
    )
    assert own == pytest.approx(0.5, rel=0.2)
    assert relative < 0.1


def test_a_constant_velocity_within_the_bias_is_no_motion() -> None:
    task = build_still_problem(NoiseModel(grade=0.3))
    own, _ = measure_speeds(task, build_states(task, 0.02 + 0j, 0j))
    assert own < 0.005
    own, _ = measure_speeds(task, build_states(task, 0.2 + 0j, 0j))
    assert own == pytest.approx(0.2, rel=0.2)


def test_relative_covariance_matches_samples() -> None:
    rng = np.random.default_rng(0)
    state = np.array([[0.4, -0.3, 0.7, 1.5, 0.8, -0.2]])
    root = 0.01 * rng.normal(size=(6, 6))
    spread = root @ root.T
    drawn = state + rng.multivariate_normal(np.zeros(6), spread, 100_000)
    for both in ((0, 1), (1, 0)):
        found = Covariances(spread[None], np.zeros((0, 0)), state).relative(state, *both)[0]
        assert found == pytest.approx(np.cov(relative_path(drawn, *both).T), rel=0.05, abs=2e-6)


def test_relative_covariance_turns_with_the_direction_to_the_peer() -> None:
    calm = np.array([[0.0, 0.0, 0.3, 2.0, 0.0, 0.0]])
    state = np.array([[0.0, 0.0, 0.3, 0.0, 2.5, 0.0]])
    spread = np.diag([0.0, 0.0, 0.01, 0.04, 0.25, 0.0])[None]
    found = Covariances(spread, np.zeros((0, 0)), calm).relative(state)[0, :2, :2]
    bearing = np.pi / 2 - 0.3
    ahead = np.array([np.cos(bearing), np.sin(bearing)])
    across = np.array([-ahead[1], ahead[0]])
    assert ahead @ found @ ahead == pytest.approx(0.04)
    assert across @ found @ across == pytest.approx(0.25 + 2.0**2 * 0.01)
    assert ahead @ found @ across == pytest.approx(0.0, abs=1e-12)


def test_covariance_without_motion_noise_is_the_inverse_normal_matrix(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(covariance, "calm_motion", lambda _problem, state: state)
    task, values = build_flight()
    quiet = replace(task, noise=replace(task.noise, grade=1e-3), views=())
    width = quiet.layout.width
    values = type(values)(values.state[:, :width], np.zeros(len(quiet.layout.constants)))
    solver = Solver(quiet)
    keyframes, constants, _ = compute_covariance(solver, values)
    equations = build_equations(solver.layout, solver.linearize(values), len(values.state))
    size = len(values.state) * width
    dense = np.zeros((size + len(constants),) * 2)
    for k, block in enumerate(equations.diagonal):
        at = slice(k * width, (k + 1) * width)
        dense[at, at] = block
        dense[at, size:] = equations.coupling[k]
        dense[size:, at] = equations.coupling[k].T
        if k:
            before = slice(at.start - width, at.start)
            dense[before, at] = equations.off_diagonal[k - 1]
            dense[at, before] = equations.off_diagonal[k - 1].T
    dense[size:, size:] = equations.globals_block
    wanted = np.linalg.inv(dense)
    assert np.sqrt(constants.diagonal()) == pytest.approx(
        np.sqrt(wanted[size:, size:].diagonal()), rel=1e-4
    )
    middle = len(values.state) // 2
    at = slice(middle * width + 3, middle * width + 5)
    assert np.sqrt(keyframes[middle].diagonal()[3:5]) == pytest.approx(
        np.sqrt(wanted[at, at].diagonal()), rel=1e-4
    )
    assert rotation_matrix(np.array(0.0)) == pytest.approx(np.eye(2))
