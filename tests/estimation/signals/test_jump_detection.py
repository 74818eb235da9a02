"""Steps of a height sensor, such as those over a box, found and removed."""

import numpy as np
import pytest

from dmrl.estimation.signals.jump_detection import remove_height_steps, step_offsets

TIME_S = np.arange(0, 60, 0.01)


def simulate_heights(noise_m: float) -> np.ndarray:
    """Return heights that vary by 0.3 m, with noise."""
    noise = np.random.default_rng(0).normal(0, noise_m, len(TIME_S))
    return np.asarray(1 + 0.3 * np.sin(TIME_S) + noise)


@pytest.mark.parametrize("noise_m", [0.0, 0.02, 0.03])
def test_height_steps_over_a_box_are_removed(noise_m: float) -> None:
    floor = simulate_heights(noise_m)
    over = ((TIME_S > 10) & (TIME_S < 12)) | ((TIME_S > 30) & (TIME_S < 31.5))
    found = remove_height_steps(TIME_S, floor - 0.35 * over)
    off = np.abs(found - floor)
    assert np.quantile(off, 0.99) < 0.06
    assert (off > 0.1).mean() < 0.001


def test_heights_that_do_not_jump_stay_as_they_are() -> None:
    for noise_m in (0.0, 0.02, 0.05):
        height = simulate_heights(noise_m)
        assert (remove_height_steps(TIME_S, height) == height).all()


def test_steps_at_both_ends_of_a_signal_are_found() -> None:
    values = np.zeros(400)
    values[:50], values[380:] = 1.0, 2.0
    found = step_offsets(values, 0.1, 0.45, 3)
    assert np.allclose(found[:50], 1.0)
    assert np.allclose(found[50:380], 0.0)
    assert np.allclose(found[380:], 2.0)


def test_step_that_never_returns_is_no_level() -> None:
    values = np.zeros(800)
    values[300:] = 1.0
    assert not step_offsets(values, 0.1, 0.45, 3).any()


@pytest.mark.parametrize(("jump", "seen"), [(0.44, False), (0.46, True)])
def test_step_must_exceed_the_minimum(jump: float, seen: bool) -> None:
    values = np.zeros(400)
    values[100:150] = jump
    found = step_offsets(values, 0.1, 0.45, 3)
    assert found.any() == seen
    if seen:
        assert np.flatnonzero(found)[[0, -1]].tolist() == [100, 149]
        assert found[100:150] == pytest.approx(np.full(50, jump))


@pytest.mark.parametrize(("lasts", "level"), [(299, True), (300, False), (301, False)])
def test_level_lasts_at_most_30_s(lasts: int, level: bool) -> None:
    values = np.zeros(800)
    values[100 : 100 + lasts] = 1.0
    assert step_offsets(values, 0.1, 0.45, 3).any() == level
    late = np.zeros(800)
    late[800 - lasts :] = 1.0  # this level lasts to the end of the signal
    assert step_offsets(late, 0.1, 0.45, 3).any() == level


@pytest.mark.parametrize(("back", "left"), [(0.6, 0.4), (0.7, 0.0)])
def test_step_back_below_half_of_the_jump_is_ignored(back: float, left: float) -> None:
    values = np.zeros(400)
    values[100:150] = 1.0
    values[150:250] = 1.0 - back
    found = step_offsets(values, 0.1, 0.3, 3)
    assert found[100:150] == pytest.approx(np.ones(50))
    assert found[200] == pytest.approx(left)


def test_climb_is_no_step_and_does_not_enlarge_a_step() -> None:
    climb = 0.4 * np.arange(400) * 0.1
    assert not step_offsets(climb, 0.1, 0.45, 3).any()
    over = climb.copy()
    over[100:150] += 0.8
    assert step_offsets(over, 0.1, 0.45, 3)[120] == pytest.approx(0.8, abs=1e-6)


def test_slope_of_a_signal_is_not_counted_as_noise() -> None:
    over = 1.5 * np.arange(400) * 0.1
    climb = over.copy()
    over[100:150] += 0.8
    assert step_offsets(over, 0.1, 0.45, 3) == pytest.approx(over - climb, abs=1e-6)


def test_few_samples_are_left_as_they_are() -> None:
    for count, seen in ((11, False), (12, True)):
        values = np.zeros(count)
        values[5:] = 1.0
        assert step_offsets(values, 0.1, 0.45, 3).any() == seen
    assert remove_height_steps(TIME_S[:2], np.ones(2)).tolist() == [1, 1]


def build_steps(*changes: tuple[int, float]) -> np.ndarray:
    """Return 600 values with jumps (index, size)."""
    values = np.zeros(600)
    for at, change in changes:
        values[at:] += change
    return values


def test_nested_and_overlapping_steps_are_found() -> None:
    for values in (
        build_steps((100, 0.7), (120, 0.5), (150, -0.5), (180, -0.7)),
        build_steps((100, 0.7), (120, 0.7), (150, -0.7), (180, -0.7)),
        build_steps((100, 0.7), (120, 0.6), (150, -1.3)),
    ):
        assert step_offsets(values, 0.1, 0.45, 3) == pytest.approx(values)


def test_missed_return_does_not_spoil_the_next_step() -> None:
    values = build_steps((100, 1.0), (300, 0.8), (340, -0.8))
    ramp = np.interp(np.arange(600), [130, 160], [0.0, -1.0])  # too slow to be a jump
    found = step_offsets(values + ramp, 0.1, 0.45, 3)
    assert found[310] == pytest.approx(0.8)
    assert not found[360:].any()
