"""The pair filter: forward and backward prediction, updates and smoothing."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.search.pair_filter import (
    HYPOTHESIS_STD,
    FilterInputs,
    Lane,
    build_inputs,
    run_lanes,
    smooth_rts,
    trace_lanes,
)
from dmrl.estimation.solver.levenberg_marquardt import relative_path

from ..solver.test_residuals import build_flight

ONE = np.zeros(1, np.intp)


def build_exact_inputs() -> tuple[FilterInputs, np.ndarray]:
    """Return the inputs of an exact flight, and its true relative path."""
    problem, values = build_flight()
    return build_inputs(replace(problem, views=())), relative_path(values.state)


def build_lanes(count: int) -> list[Lane]:
    """Return a forward and a backward lane over all keyframes."""
    return [Lane(np.arange(count), True), Lane(np.arange(count)[::-1], False)]


@pytest.mark.parametrize("way", [0, 1])
def test_filter_started_at_truth_stays_there_in_both_directions(way: int) -> None:
    made, true = build_exact_inputs()
    lane = build_lanes(len(true))[way]
    run = run_lanes(made, [lane], true[lane.keyframe[:1]], ONE, len(true))
    error = run.state[:, 0, :3] - true[lane.keyframe]
    assert np.abs(error[:, :2]).max() < 0.03
    assert np.abs(np.angle(np.exp(1j * error[:, 2]))).max() < 0.03
    assert run.log_likelihood.shape == (len(true), 1)


def test_backward_prediction_inverts_forward_prediction() -> None:
    made, true = build_exact_inputs()
    blind = replace(made, range_m=np.full(len(true), np.nan))
    ahead = run_lanes(blind, [Lane(np.arange(5, 9), True)], true[5:6], ONE, 4)
    there = ahead.state[-1, :, :3]
    back = run_lanes(blind, [Lane(np.arange(8, 4, -1), False)], there, ONE, 4)
    assert back.state[-1, 0, :3] == pytest.approx(true[5], abs=1e-6)
    assert ahead.state[1:, 0, :3] == pytest.approx(true[6:9], abs=2e-3)


def test_bias_jacobian_changes_sign_backward_in_time() -> None:
    made, true = build_exact_inputs()
    blind = replace(made, range_m=np.full(len(true), np.nan))
    step = 1e-6
    for lane in (Lane(np.arange(5, 9), True), Lane(np.arange(8, 4, -1), False)):
        run = run_lanes(blind, [lane], true[lane.keyframe[:1]], ONE, 4)
        # The Jacobian of the step equals finite differences of the propagation.
        for column in range(3):
            moved = true[lane.keyframe[:1]].copy()
            moved[0, column] += step
            ends = run_lanes(blind, [lane], moved, ONE, 2).state[1, 0]
            slope = (ends - run.state[1, 0]) / step
            assert run.step[1, 0, :, column] == pytest.approx(slope, abs=1e-4)
        # The step back from keyframe 8 has the length of the step forward from 7.
        seconds = made.step_s[5] if lane.forwards else -made.step_s[7]
        assert run.step[1, 0, 2, 3:] == pytest.approx([seconds, -seconds])


def test_range_update_is_radial_and_robust() -> None:
    made, true = build_exact_inputs()
    results = []
    for excess in (0.0, 0.2, 5.0):
        longer = replace(made, range_m=made.range_m + excess)
        run = run_lanes(longer, [Lane(np.arange(1), True)], true[:1], ONE, 1)
        results.append(run)
    towards = true[0, :2] / np.hypot(*true[0, :2])
    moved = [(r.state[0, 0, :2] - true[0, :2]) @ towards for r in results]
    assert abs(moved[0]) < 0.02 < moved[1] < 0.25
    assert moved[2] < 2.0
    assert results[2].log_likelihood[0, 0] < results[1].log_likelihood[0, 0]
    # The update follows the textbook where nothing is down-weighted.
    spread = HYPOTHESIS_STD[0] ** 2
    level = np.hypot(*true[0, :2]) / np.sqrt((true[0, :2] ** 2).sum() + made.height_m[0] ** 2)
    wanted = spread * level / (spread * level**2 + made.range_var[0])
    innovation = made.range_m[0] - np.sqrt((true[0, :2] ** 2).sum() + made.height_m[0] ** 2)
    assert moved[0] == pytest.approx(wanted * innovation, rel=0.02, abs=1e-6)
    kept = results[0].covariance[0, 0, :2, :2]
    assert towards @ kept @ towards == pytest.approx(spread * (1 - wanted * level), rel=0.02)


def test_bearing_update_rotates_the_peer_to_the_detection() -> None:
    problem, values = build_flight()
    true = relative_path(values.state)
    made = build_inputs(problem)
    key = min(made.images)
    off = 0.3
    start = true[key : key + 1].copy()
    start[0, :2] = rotate(rotation_matrix(np.array([off])), start[:, :2])[0]
    sides = [image[0] for image in made.images[key]]
    assert sorted(sides) == [-1.0, 1.0]
    for image in made.images[key]:
        one = replace(made, images={key: [image]}, range_m=np.full(len(true), np.nan))
        run = run_lanes(one, [Lane(np.array([key]), True)], start, ONE, 1)
        found = run.state[0, 0, :3]
        if image[0] > 0:
            turned = np.arctan2(found[1], found[0]) - np.arctan2(true[key, 1], true[key, 0])
            assert abs(turned) < 0.1
        else:
            # The peer's camera tells its heading.
            assert abs(found[2] - start[0, 2] - off) < 0.15
        away = run_lanes(one, [Lane(np.array([key]), True)], start + np.array([0, 0, 3.0]), ONE, 1)
        if image[0] < 0:
            assert away.state[0, 0, 2] == pytest.approx(start[0, 2] + 3.0)


def test_parallel_lanes_equal_single_lanes_and_short_ones_stay_constant() -> None:
    made, true = build_exact_inputs()
    both = [Lane(np.arange(len(true)), True), Lane(np.arange(3, -1, -1), False)]
    start = np.stack([true[0], true[3]])
    run = run_lanes(made, both, start, np.arange(2), len(true))
    light = trace_lanes(made, both, start, np.arange(2), len(true))
    assert (light.state == run.state).all()
    assert (light.log_likelihood == run.log_likelihood).all()
    for number, lane in enumerate(both):
        alone = run_lanes(made, [lane], start[number : number + 1], ONE, len(lane.keyframe))
        count = len(lane.keyframe)
        assert run.state[:count, number] == pytest.approx(alone.state[:, 0])
    assert (run.state[4:, 1] == run.state[3, 1]).all()
    assert not run.log_likelihood[4:, 1].any()


def test_smoothing_carries_later_ranges_back() -> None:
    made, true = build_exact_inputs()
    wrong = true[:1] + np.array([0.25, -0.2, 0.3])
    run = run_lanes(made, [Lane(np.arange(len(true)), True)], wrong, ONE, len(true))
    smooth = smooth_rts(run)
    assert smooth[-1] == pytest.approx(run.state[-1])
    before, after = (np.hypot(*(s[0, 0, :2] - true[0, :2])) for s in (run.state, smooth))
    assert after < before
