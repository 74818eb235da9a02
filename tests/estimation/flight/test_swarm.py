"""Joint solve of all robots: as accurate and consistent as pairwise solves."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import combinations
from unittest.mock import Mock

import numpy as np
import pytest

from dmrl.estimation.flight import windows
from dmrl.estimation.flight.pairs import estimate_ekf, estimate_pairs
from dmrl.estimation.flight.swarm import estimate_swarm
from dmrl.estimation.model.pair import Array, Pair, SensorTrack
from dmrl.estimation.model.status import AMBIGUOUS, OK
from dmrl.estimation.solver.estimate import Estimate, seen_from_peer
from dmrl.flight import NOISE, Fault, Flight, Scenario, Trajectory, simulate

from ..flights import build_pair, compute_truth
from ..sighted_flights import compute_rmse, simulate_bearings

pytestmark = pytest.mark.heavy

Names = tuple[str, str]
Estimates = dict[Names, Estimate]


@cache
def solve_flight(
    trajectory: Trajectory,
    noise: str,
    robots: int = 3,
    faults: tuple[Fault, ...] = (),
    duration_s: float = 40.0,
) -> tuple[Flight, dict[Names, Pair], Estimates, Estimates]:
    """Return a flight, its pairs, and their estimates by pairs and together."""
    flight = simulate(Scenario(robots, duration_s, trajectory), NOISE[noise], 1, faults)
    pairs = {names: build_pair(flight, *names) for names in combinations(flight.robots, 2)}
    both = solve_pairs(pairs)
    return flight, pairs, both, estimate_swarm(pairs, both)


def solve_pairs(pairs: dict[Names, Pair]) -> Estimates:
    """Return the estimates of both directions of some pairs, under the plain model."""
    out: Estimates = {}
    estimates = estimate_pairs(list(pairs.values()), plain=True)
    for names, (here, there) in zip(pairs, estimates, strict=True):
        out |= {names: here, names[::-1]: there}
    return out


def change_robot(
    pairs: dict[Names, Pair], robot: str, change: Callable[[SensorTrack, Array], SensorTrack]
) -> dict[Names, Pair]:
    """Return the pairs with another log of a robot; `change` gets the log and its (N,) times."""
    out = dict(pairs)
    for names, pair in pairs.items():
        if robot in names:
            side = ("own", "peer")[names.index(robot)]
            out[names] = replace(pair, **{side: change(getattr(pair, side), pair.time_s)})
    return out


def compute_errors(flight: Flight, estimates: Estimates) -> np.ndarray:
    """Return the horizontal errors of every ordered pair, metres."""
    return np.concatenate(
        [
            np.linalg.norm(e.state[:, :2] - compute_truth(flight, e.time_s, *names), axis=1)
            for names, e in estimates.items()
        ]
    )


@pytest.mark.parametrize(("noise", "share"), [("calibrated", 1.0), ("realistic", 1.02)])
def test_swarm_solve_is_as_accurate_as_pairwise_solves(noise: str, share: float) -> None:
    """With little noise nearer; else, where a sure pair contradicts, they are the pairs' own."""
    flight, _, pairwise, swarm = solve_flight("in_view", noise)
    assert set(swarm) == set(pairwise)
    one, other = (np.sqrt(np.mean(compute_errors(flight, e) ** 2)) for e in (pairwise, swarm))
    assert other < share * one


def test_swarm_covariances_cover_truth_and_ok_positions_are_accurate() -> None:
    flight, _, _, swarm = solve_flight("random", "realistic")
    inside, bad, kept = [], 0, 0
    for names, e in swarm.items():
        error = e.state[:, :2] - compute_truth(flight, e.time_s, *names)
        squared = np.einsum("ki,kij,kj->k", error, np.linalg.inv(e.covariance[:, :2, :2]), error)
        inside.append((squared < 5.991).mean())
        bad += int((np.linalg.norm(error, axis=1)[e.status == OK] > 0.3).sum())
        kept += int((e.status == OK).sum())
    assert np.mean(inside) > 0.9
    assert kept > 500 and bad <= 0.02 * kept


def test_swarm_positions_are_consistent_around_a_triangle() -> None:
    *_, swarm = solve_flight("random", "realistic")
    one, two, three = (swarm[n].state for n in (("cf1", "cf2"), ("cf2", "cf3"), ("cf1", "cf3")))
    turn = np.exp(1j * one[:, 2])
    around = one[:, 0] + 1j * one[:, 1] + turn * (two[:, 0] + 1j * two[:, 1])
    assert np.allclose(around, three[:, 0] + 1j * three[:, 1])


@pytest.mark.parametrize("trajectory", ["parallel", "hover"])
def test_unobservable_swarm_motion_has_no_ok_positions(trajectory: Trajectory) -> None:
    *_, swarm = solve_flight(trajectory, "calibrated", duration_s=20.0)
    for estimate in swarm.values():
        assert not (estimate.status == OK).any()


def test_static_observer_has_ambiguous_bearings() -> None:
    *_, swarm = solve_flight("observer_static", "calibrated", duration_s=20.0)
    for peer in ("cf2", "cf3"):
        assert (swarm["cf1", peer].status == AMBIGUOUS).mean() > 0.9


def test_swarm_solve_leaves_out_a_single_pair() -> None:
    names = ("cf1", "cf2")
    pair = build_pair(simulate(Scenario(2, 10.0), NOISE["realistic"], 1))
    (estimate,) = estimate_ekf([pair], "published-sim")
    alone = {names: estimate, names[::-1]: seen_from_peer(estimate)}
    assert estimate_swarm({names: pair}, alone) == {}


def test_shadowed_ranges_of_one_pair_do_not_bend_the_others() -> None:
    # Ranges 1 m too long for 3 s, twice: taken as they are, all three robots were 0.3 m off.
    shadow = Fault("nlos", "cf1", "cf2", size=1.0, duration_s=3.0, number=2)
    flight, pairs, both, swarm = solve_flight("in_view", "calibrated", 3, (shadow,))
    error = compute_errors(flight, swarm)
    kept = np.concatenate([e.status == OK for e in swarm.values()])
    assert kept.mean() > 0.5
    assert (error[kept] > 0.3).mean() < 0.02
    # Without the unknown of the range error the joint solve does not fit.
    blind = {names: replace(e, range_error_m=None) for names, e in both.items()}
    assert estimate_swarm(pairs, blind) == {}


def test_a_gyroscope_that_drifts_is_identified_in_a_swarm() -> None:
    flight, pairs, *_ = solve_flight("random", "calibrated", 4)
    drift = change_robot(
        pairs,
        "cf3",
        lambda track, time_s: replace(
            track, yaw_rate_radps=track.yaw_rate_radps + 0.1 * time_s / time_s[-1]
        ),
    )
    swarm = estimate_swarm(drift, solve_pairs(drift))
    for names, estimate in swarm.items():
        found = [cause.name for cause in estimate.causes if cause.robot is not None]
        assert found == ["yaw rate bias changes"] * ("cf3" in names)
    kept = np.concatenate([estimate.status == OK for estimate in swarm.values()])
    assert len(swarm) == 12 and kept.mean() > 0.9
    assert (compute_errors(flight, swarm)[kept] > 0.3).mean() < 0.05  # 0.09 without the model


def test_a_robot_that_no_model_explains_is_left_out() -> None:
    flight, pairs, *_ = solve_flight("random", "calibrated", 4)
    negated = change_robot(
        pairs, "cf3", lambda track, _: replace(track, yaw_rate_radps=-track.yaw_rate_radps)
    )
    swarm = estimate_swarm(negated, solve_pairs(negated))
    assert {name for names in swarm for name in names} == {"cf1", "cf2", "cf4"}
    kept = np.concatenate([estimate.status == OK for estimate in swarm.values()])
    assert kept.mean() > 0.9
    assert (compute_errors(flight, swarm)[kept] > 0.3).mean() < 0.02


def test_a_group_without_a_solution_is_left_to_its_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    _, pairs, both, _ = solve_flight("random", "calibrated", duration_s=20.0)
    unsolved = Mock(side_effect=np.linalg.LinAlgError)
    monkeypatch.setattr("dmrl.estimation.flight.swarm._solve_group", unsolved)
    assert estimate_swarm(pairs, both) == {}


def test_a_robot_that_flies_for_a_shorter_time_is_left_out() -> None:
    _, pairs, *_ = solve_flight("random", "calibrated", 4)
    landed = {n: pair.crop(0.0, 25.0) if "cf2" in n else pair for n, pair in pairs.items()}
    swarm = estimate_swarm(landed, solve_pairs(landed))
    assert {name for names in swarm for name in names} == {"cf1", "cf3", "cf4"}
    assert min(estimate.time_s[-1] for estimate in swarm.values()) > 39.0


def test_clock_offset_is_estimated_in_a_swarm() -> None:
    late_s = 0.06
    flight = simulate(Scenario(3, 40.0, "random"), NOISE["calibrated"], 1)
    pairs = {names: build_pair(flight, *names) for names in combinations(flight.robots, 2)}

    def delay(track: SensorTrack, time_s: Array) -> SensorTrack:
        """Return a log that is stamped late."""
        signals = [np.interp(time_s - late_s, time_s, s) for s in track.signals()]
        return SensorTrack(*signals, track.dropout)

    shifted = change_robot(pairs, "cf3", delay)
    swarm = estimate_swarm(shifted, solve_pairs(shifted))
    assert swarm["cf1", "cf3"].value("clock", 1) == pytest.approx(late_s, abs=0.02)
    assert swarm["cf3", "cf1"].value("clock", 1) == pytest.approx(-late_s, abs=0.02)
    assert swarm["cf1", "cf2"].value("clock", 1) == pytest.approx(0.0, abs=0.02)
    assert swarm["cf2", "cf3"].value("clock", 1) == pytest.approx(late_s, abs=0.02)


def test_detections_improve_a_swarm_solve() -> None:
    flight, pairs, both, swarm = solve_flight("in_view", "calibrated")
    sees = simulate_bearings(flight, "cf1", ("cf2",))
    looking = {
        names: replace(pair, own_bearings=sees) if names == ("cf1", "cf2") else pair
        for names, pair in pairs.items()
    }
    seen = estimate_swarm(looking, both)
    names = ("cf1", "cf2")
    error = [
        compute_rmse(found[names].state[:, :2], compute_truth(flight, found[names].time_s, *names))
        for found in (swarm, seen)
    ]
    assert error[1] < 0.7 * error[0]


def test_a_long_swarm_is_solved_in_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    flight, pairs, both, whole = solve_flight("random", "calibrated")
    monkeypatch.setattr(windows, "WINDOW_S", 16.0)
    monkeypatch.setattr(windows, "OVERLAP_S", 6.0)
    parts = estimate_swarm(pairs, both)
    names = ("cf1", "cf2")
    assert parts[names].time_s == pytest.approx(whole[names].time_s)
    rms = [float(np.sqrt((compute_errors(flight, e) ** 2).mean())) for e in (whole, parts)]
    assert rms[1] < 1.5 * rms[0] + 0.02
