"""Modes of a flight: mirrored copies, and the selection of distinct, likely ones."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.search.hypotheses import Track
from dmrl.estimation.search.modes import (
    MAX_MODES,
    MAX_PASS_M,
    MODE_COST_MARGIN,
    _composite,
    coarsen,
    convert_values,
    dead_reckon,
    find_modes,
    mirror_copies,
    place_peer,
    select_modes,
)
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate, relative_path
from dmrl.estimation.solver.residuals import Values

from ..flights import build_pair, compute_truth, simulate_flight
from ..solver.test_residuals import build_flight, perturb


def build_pass(nearest_m: float) -> np.ndarray:
    """Return the (21, 3) path of a peer that passes along x at a distance, at 5 keyframes/s."""
    along = np.linspace(-2, 2, 21)
    return np.column_stack([along, np.full(21, nearest_m), np.zeros(21)])


def test_mirror_copy_flips_a_close_pass_only() -> None:
    path = build_pass(0.2)
    (copy,) = mirror_copies(path, 5.0)
    assert copy[10] == pytest.approx([0.0, -0.2, 0.0])
    assert copy[[0, -1]] == pytest.approx(path[[0, -1]])
    assert copy[:, 0] == pytest.approx(path[:, 0])
    assert not mirror_copies(build_pass(MAX_PASS_M + 0.05), 5.0)


def test_mirror_copies_swap_side_between_close_passes() -> None:
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    loop = np.column_stack([2 * np.sin(angle), 1.0 * np.sin(2 * angle) + 0.1, np.zeros(60)])
    copies = mirror_copies(loop, 5.0)
    passes = np.flatnonzero(np.hypot(*loop[:, :2].T) < 0.2)
    assert len(copies) >= 3 and len(passes) >= 2
    mirrored = copies[-1]
    kept = np.hypot(*mirrored[:, :2].T) - np.hypot(*loop[:, :2].T)
    assert np.abs(kept).max() < 1e-9
    assert np.abs(mirrored - loop).max() > 1.0


def test_nearest_pass_is_mirrored_first() -> None:
    path = np.concatenate([build_pass(0.4), build_pass(0.1), build_pass(0.3)])
    path[:, 0] = np.concatenate([np.linspace(-2, 2, 21) * way for way in (1, -1, 1)])
    first = mirror_copies(path, 5.0)[0]
    assert first[31, 1] == pytest.approx(-0.1)
    assert first[10] == pytest.approx(path[10])


def test_modes_are_distinct_and_nearly_as_good_as_the_best() -> None:
    _, true = build_flight()

    def at(y_m: float, cost: float) -> MapEstimate:
        state = true.state.copy()
        state[:, 4] += y_m
        return MapEstimate(Values(state, true.constants), cost)

    best, same, far = at(0.0, 10.0), at(0.1, 11.0), at(1.0, 10.0 + MODE_COST_MARGIN - 0.1)
    lost = at(2.0, 10.0 + MODE_COST_MARGIN + 0.1)
    assert select_modes([lost, far, same, best]) == [best, far]
    assert len(select_modes([at(k, 10.0) for k in range(9)])) == MAX_MODES


def test_coarse_problem_has_one_range_per_keyframe_and_white_noise() -> None:
    problem, true = build_flight()
    coarse = coarsen(problem)
    assert len(coarse.links[0].range_m) <= len(problem.keyframe_s)
    assert coarse.velocity_psd == pytest.approx(problem.velocity_psd)
    assert coarse.layout.state_column("velocity_error_x", 0) is None
    values = perturb(true)
    there = convert_values(values, problem.layout, coarse.layout)
    back = convert_values(there, coarse.layout, problem.layout)
    assert (back.state[:, :6] == values.state[:, :6]).all()
    assert (back.constants == values.constants).all()
    column = problem.layout.state_column("range_error", 0, 1)
    assert (back.state[:, column] == values.state[:, column]).all()
    assert not back.state[:, problem.layout.state_column("velocity_error_x", 1)].any()


def test_values_are_built_from_a_track_or_from_dead_reckoning() -> None:
    problem, true = build_flight()
    path = relative_path(true.state)
    found = place_peer(problem, path, np.array([0.01, -0.02]))
    assert relative_path(found.state) == pytest.approx(path, abs=1e-9)
    assert found.constants[problem.layout.find("gyro_bias", 1)] == -0.02
    turned = found.state[-1, 2] - problem.robots[0].motion.turn_rad.sum()
    assert turned == pytest.approx(-0.01 * (problem.keyframe_s[-1] - problem.keyframe_s[0]))
    first = np.concatenate([true.state[0], true.constants + 0.5])
    reckoned = dead_reckon(problem, first)
    assert reckoned.state[:, :6] == pytest.approx(true.state[:, :6], abs=2e-3)
    assert (reckoned.constants == 0.5).all()


def test_composite_track_takes_the_most_likely_segments() -> None:
    def track(x_m: float, turns: int, *scores: float) -> Track:
        pose = np.tile([x_m, 0.0, 2 * np.pi * turns], (6, 1))
        return Track(pose, np.zeros(2), np.repeat(scores, 3))

    made = _composite([track(0.0, 0, 5.0, 1.0), track(1.0, 1, 2.0, 3.0)], np.array([0, 3]))
    assert made.pose[:, 0].tolist() == [0, 0, 0, 1, 1, 1]
    assert made.pose[:, 2] == pytest.approx(0.0)
    assert made.score == pytest.approx(24.0)


@pytest.mark.heavy
def test_the_modes_of_a_flight_contain_the_truth() -> None:
    world = simulate_flight("random", "calibrated", 1001, 60.0)
    problem = build_problem({(0, 1): build_pair(world)})
    modes = find_modes(problem)
    error = relative_path(modes[0].values.state)[:, :2] - compute_truth(world, problem.keyframe_s)
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.2
    assert [m.cost for m in modes] == sorted(m.cost for m in modes)


@pytest.mark.heavy
def test_too_short_ranges_do_not_collapse_the_solve() -> None:
    world = simulate_flight("in_view", "calibrated", 1003, 60.0)
    pair = build_pair(world)
    short = replace(pair, range_m=np.maximum(pair.range_m - 0.4, 0.02))
    problem = build_problem({(0, 1): short})
    error = relative_path(find_modes(problem)[0].values.state)[:, :2]
    error = error - compute_truth(world, problem.keyframe_s)
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.35
