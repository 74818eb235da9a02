from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dmrl import messages
from dmrl.estimation.evidence.model_trials import Member
from dmrl.estimation.evidence.posterior import Mixture
from dmrl.estimation.flight.pair_output import SIGMA_FACTOR, mix_members
from dmrl.estimation.flight.pair_solver import WindowSolution
from dmrl.estimation.flight.pairs import estimate_ekf, estimate_pairs
from dmrl.estimation.model import status as room
from dmrl.estimation.model.odometry import Odometry
from dmrl.estimation.model.pair import Pair, SensorTrack
from dmrl.estimation.search.modes import COST_SCALE, mode_weights
from dmrl.estimation.solver.covariance import Covariances
from dmrl.estimation.solver.estimate import (
    PAIR_LAYOUT,
    REASONS,
    TOO_NOISY,
    Estimate,
    seen_from_peer,
    transform_to_peer,
)
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate, Solver
from dmrl.estimation.solver.problem import NoiseModel
from dmrl.estimation.solver.residuals import Values
from dmrl.flight import Trajectory

from ..flights import build_pair, compute_truth, simulate_flight

LONG_S = 60.0
Both = tuple[Estimate, Estimate]


@cache
def solved(trajectory: Trajectory, noise: str, seed: int) -> Both:
    """What a minute's flight of one pair is estimated to be: once, for every test that asks."""
    (found,) = estimate_pairs([build_pair(simulate_flight(trajectory, noise, seed, LONG_S))])
    return found


def compute_rmse(
    estimate: Estimate,
    seed: int,
    noise: str = "calibrated",
    own: str = "cf1",
    *,
    duration_s: float = LONG_S,
) -> float:
    flight = simulate_flight("in_view", noise, seed, duration_s)
    peer = "cf2" if own == "cf1" else "cf1"
    error = estimate.state[:, :2] - compute_truth(flight, estimate.time_s, own, peer)
    settled = estimate.time_s - estimate.time_s[0] > 20
    return float(np.sqrt((error[settled] ** 2).sum(axis=1).mean()))


def test_covariance_includes_distance_between_modes() -> None:
    """Two solutions of one weight, 1 m apart."""
    problem = build_problem(
        {(0, 1): build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))}
    )
    count, width = len(problem.keyframe_s), problem.layout.width
    state = np.zeros((count, width))
    state[:, 3] = 2.0
    other = state.copy()
    other[:, 3] += 1.0
    other[:, 5] += 2 * np.pi
    still = replace(
        problem, robots=tuple(replace(r, path=_at_rest(r.path)) for r in problem.robots)
    )
    members = [
        Member(Solver(still), MapEstimate(Values(s, np.zeros(0)), 7.0), 0.0) for s in (state, other)
    ]
    spread = Covariances(np.zeros((count, width, width)), np.zeros((0, 0)), state)
    found = WindowSolution(Mixture(members, np.array([0.5, 0.5])), [spread, spread])
    mean, covariance = mix_members(found, problem.keyframe_s[:3])
    assert mean == pytest.approx(np.tile([2.5, 0.0, 0.0], (3, 1)))
    assert covariance == pytest.approx(
        np.tile(np.diag([0.25, 0.0, 0.0]) * SIGMA_FACTOR[0] ** 2, (3, 1, 1)), abs=1e-12
    )


def _at_rest(path: Odometry) -> Odometry:
    return replace(path, heading_rad=0 * path.heading_rad, position_m=0 * path.position_m)


def test_modes_of_equal_cost_have_equal_weights() -> None:
    modes = [MapEstimate(Values(np.zeros((3, 6)), np.zeros(0)), 7.0) for _ in range(2)]
    assert mode_weights(modes) == pytest.approx([0.5, 0.5])
    assert mode_weights([modes[0], replace(modes[1], cost=7.0 + COST_SCALE)]) == pytest.approx(
        np.array([1, np.exp(-1)]) / (1 + np.exp(-1))
    )


def test_statuses_equal_the_schema() -> None:
    assert (room.OK, room.UNCONVERGED, room.AMBIGUOUS) == (
        messages.STATUS_OK,
        messages.STATUS_UNCONVERGED,
        messages.STATUS_AMBIGUOUS,
    )


@pytest.mark.heavy
def test_batch_solve_is_more_accurate_than_the_published_filter() -> None:
    seeds = (1000, 1001, 1002, 1003)
    pairs = [build_pair(simulate_flight("in_view", "calibrated", seed, LONG_S)) for seed in seeds]
    published = [
        compute_rmse(e, s) for e, s in zip(estimate_ekf(pairs, "published-sim"), seeds, strict=True)
    ]
    batch = [compute_rmse(solved("in_view", "calibrated", s)[0], s) for s in seeds]
    assert np.median(batch) < np.median(published)
    assert max(batch) < 0.35


@pytest.mark.heavy
def test_noise_scale_orders_calibrated_realistic_and_harsh_sensors() -> None:
    grades = [solved("in_view", n, 1001)[0].noise for n in ("calibrated", "realistic", "harsh")]
    assert grades[0].grade < grades[1].grade < grades[2].grade
    assert grades[0].grade < 0.8 < grades[2].grade
    assert grades[0].constants_grade >= 0.8


@pytest.mark.heavy
def test_both_directions_are_transforms_of_one_solve() -> None:
    here, there = solved("in_view", "calibrated", 1001)
    assert compute_rmse(there, 1001, own="cf2") < 0.35
    assert np.allclose(transform_to_peer(there.state), here.state)
    again = seen_from_peer(seen_from_peer(here))
    assert np.allclose(again.covariance, here.covariance)
    assert np.allclose(again.constants, here.constants)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("trajectory", "noise"),
    [
        ("observer_static", "realistic"),
        ("parallel", "harsh"),
        ("both_static", "harsh"),
        ("hover", "realistic"),
    ],
)
def test_unobservable_bearing_is_ambiguous_with_a_reason(
    trajectory: Trajectory, noise: str
) -> None:
    (estimate, _) = solved(trajectory, noise, 1000)
    assert (estimate.status == room.AMBIGUOUS).mean() > 0.9
    reasons = {REASONS[reason] for reason in ("still", "alike", "open")}
    assert reasons & {cause.name for cause in estimate.causes}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1005))
@pytest.mark.parametrize("trajectory", ["observer_static", "parallel", "both_static", "hover"])
@pytest.mark.parametrize("noise", ["realistic", "harsh"])
def test_unobservable_bearing_is_ambiguous_in_other_flights(
    trajectory: Trajectory, noise: str, seed: int
) -> None:
    (estimate, _) = solved(trajectory, noise, seed)
    assert (estimate.status == room.AMBIGUOUS).mean() > 0.9


@pytest.mark.heavy
@pytest.mark.parametrize("seed", [1001, 1003])
def test_harsh_noise_is_refused_by_its_name(seed: int) -> None:
    for estimate in solved("in_view", "harsh", seed):
        assert not (estimate.status == room.OK).any()
        assert TOO_NOISY in {cause.name for cause in estimate.causes}


@pytest.mark.heavy
def test_a_flight_that_nothing_explains_is_refused() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1001, LONG_S))
    long = pair.range_m + 0.4 * (pair.range_time_s.astype(int) % 2)  # every other second
    for estimate in estimate_pairs([replace(pair, range_m=long)])[0]:
        assert not (estimate.status == room.OK).any()
        assert any(cause.refuses for cause in estimate.causes)


@pytest.mark.heavy
def test_no_position_is_ok_during_sensor_dropout() -> None:
    pair = build_pair(simulate_flight("random", "calibrated", 1001, LONG_S))
    gap = (pair.time_s > 30) & (pair.time_s < 33)
    held = SensorTrack(*(np.where(gap, 0.0, signal) for signal in pair.own.signals()), gap)
    ((estimate, _),) = estimate_pairs(
        [Pair(pair.time_s, held, pair.peer, pair.range_time_s, pair.range_m)]
    )
    inside = (estimate.time_s > 30.05) & (estimate.time_s < 32.95)
    assert (estimate.status[inside] != room.OK).all()
    assert (estimate.status == room.OK).mean() > 0.2


@pytest.mark.heavy
def test_no_position_is_ok_during_range_dropout_and_distance_stays_bounded() -> None:
    pair = build_pair(simulate_flight("random", "calibrated", 1000, LONG_S))
    kept = (pair.range_time_s < 30) | (pair.range_time_s > 33)
    range_time_s, range_m = pair.range_time_s[kept], pair.range_m[kept]
    ((estimate, _),) = estimate_pairs([replace(pair, range_time_s=range_time_s, range_m=range_m)])
    inside = (estimate.time_s > 30.05) & (estimate.time_s < 32.95)
    assert (estimate.status[inside] != room.OK).all()
    assert (estimate.status == room.OK).mean() > 0.2
    assert np.hypot(*estimate.state[:, :2].T).max() < range_m.max() + 0.5


@pytest.mark.heavy
@pytest.mark.parametrize("fault", ["shadowed", "own bias", "peer bias", "offset"])
def test_solve_is_robust_to_range_and_gyro_faults(fault: str) -> None:
    # A minute does not tell an offset of the ranges well enough to keep anything.
    duration_s = 100.0 if fault == "offset" else LONG_S
    pair = build_pair(simulate_flight("in_view", "calibrated", 1002, duration_s))
    if fault in ("shadowed", "offset"):
        burst = (pair.range_time_s > 30) & (pair.range_time_s < 33)
        longer = 0.35 if fault == "offset" else 1.0 * burst
        pair = replace(pair, range_m=pair.range_m + longer)
    else:
        side = "own" if fault == "own bias" else "peer"
        log = getattr(pair, side)
        biased = replace(log, yaw_rate_radps=log.yaw_rate_radps + 0.05)
        pair = replace(pair, **{side: biased})
    ((estimate, _),) = estimate_pairs([pair])
    assert compute_rmse(estimate, 1002, duration_s=duration_s) < 0.16
    assert (estimate.status == room.OK).mean() > 0.5


@pytest.mark.heavy
def test_a_flight_without_ranges_is_ambiguous() -> None:
    pair = build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0))
    none = Pair(pair.time_s, pair.own, pair.peer, np.zeros(0), np.zeros(0))
    ((estimate, _),) = estimate_pairs([none])
    assert (estimate.status == room.AMBIGUOUS).all()


@pytest.mark.heavy
def test_pairs_of_different_length_equal_separate_estimates() -> None:
    pairs = [
        build_pair(simulate_flight("in_view", "calibrated", 1000 + k, 4.0 + k)) for k in range(2)
    ]
    together = estimate_pairs(pairs)
    for pair, (estimate, _) in zip(pairs, together, strict=True):
        ((alone, _),) = estimate_pairs([pair])
        assert np.allclose(alone.state, estimate.state)


def test_positions_are_interpolated_and_unconverged_outside_the_flight() -> None:
    none = np.zeros(2, np.int8)
    estimate = Estimate(
        np.array([0.0, 1.0]),
        np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.0]]),
        np.stack([np.eye(3), 3 * np.eye(3)]),
        none,
        np.zeros(len(PAIR_LAYOUT.constants)),
        NoiseModel(),
    )
    xy, covariance, status = estimate.interpolate_at(np.array([0.5, 2.0]))
    assert xy.tolist() == [[0.5, 1.0], [1.0, 2.0]]
    assert covariance[0].tolist() == (2 * np.eye(2)).tolist()
    assert status.tolist() == [room.OK, room.UNCONVERGED]


def test_interpolation_takes_worse_status_and_peer_covariance_is_sampled() -> None:
    spread = np.array([[0.02, 0.01, 0.003], [0.01, 0.03, -0.002], [0.003, -0.002, 0.01]])
    state = np.array([[1.0, 0.5, 0.4], [1.0, 0.5, 0.4]])
    status = np.array([room.OK, room.AMBIGUOUS], np.int8)
    constants = np.arange(13.0)
    estimate = Estimate(
        np.arange(2.0), state, np.stack([spread] * 2), status, constants, NoiseModel()
    )
    assert (
        estimate.interpolate_at(np.array([0.0, 0.5, 1.0, 1.5]))[2].tolist() == [room.AMBIGUOUS] * 4
    )
    back = seen_from_peer(estimate)
    assert back.value("clock", 1) == -estimate.value("clock", 1)
    drawn = np.random.default_rng(0).multivariate_normal(state[0], 1e-4 * spread, 100_000)
    seen = np.cov(transform_to_peer(drawn).T) * 1e4
    assert back.covariance[0] == pytest.approx(seen, abs=3e-4)
    # A peer 1 m ahead that faces left sees the observer 1 m to its left.
    assert transform_to_peer(np.array([[1.0, 0.0, np.pi / 2]]))[0] == pytest.approx(
        [0, 1, -np.pi / 2]
    )
