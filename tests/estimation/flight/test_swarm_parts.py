"""The parts of a swarm's solve, with robots whose every motion is known."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from dmrl.estimation.flight import swarm
from dmrl.estimation.flight.pairs import insufficient_excitation, with_status
from dmrl.estimation.flight.swarm import (
    _denoise_paths,
    _initial_state,
    _motion_energy,
    _pair_constants,
    _relative_pose,
    build_swarm_problem,
    estimate_swarm,
)
from dmrl.estimation.model.pair import Array, Pair, SensorTrack
from dmrl.estimation.model.status import AMBIGUOUS, OK, UNCONVERGED
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import GLOBALS, NoiseModel
from dmrl.estimation.solver.multi_robot import (
    CONSTANTS_PER_LINK,
    CONSTANTS_PER_ROBOT,
    STATES_PER_ROBOT,
    SwarmEstimate,
    SwarmProblem,
)
from dmrl.estimation.solver.residuals import OWN_GYRO, PEER_GYRO, RANGE_BIAS

NAMES = ("a", "b", "c")
MOTION = {"a": (0.3 - 0.1j, 0.2), "b": (-0.2 + 0.4j, -0.35), "c": (0.5 + 0.1j, 0.15)}
PLACED = {"a": (0j, 0.0), "b": (2 + 1j, 0.7), "c": (-1 + 2j, -1.2)}
TIME_S = {("a", "b"): (5.0, 45.0), ("a", "c"): (6.0, 44.0), ("b", "c"): (4.0, 46.5)}


def at(name: str, time_s: Array) -> tuple[Array, Array]:
    """Where a robot is, as x + iy, and its heading: on a circle, from a place of its own."""
    (speed, turn), (place, heading) = MOTION[name], PLACED[name]
    since = time_s - 6.0
    moved = speed * (np.exp(1j * turn * since) - 1) / (1j * turn)
    return place + np.exp(1j * heading) * moved, heading + turn * since


def pairs() -> dict[tuple[str, str], Pair]:
    found = {}
    for names, (start_s, end_s) in TIME_S.items():
        time_s = start_s + np.arange(round(100 * (end_s - start_s)) + 1) / 100
        ones = np.ones(len(time_s))
        tracks = []
        for name in names:
            speed, turn = MOTION[name]
            gap = (time_s > 20) & (time_s < 22) if name == "b" else ones < 0
            height_m = (1 + NAMES.index(name)) * ones + 0.01 * time_s * NAMES.index(name)
            tracks.append(
                SensorTrack(speed.real * ones, speed.imag * ones, turn * ones, height_m, gap)
            )
        ranges_s = np.arange(start_s, end_s, 0.07)
        found[names] = Pair(time_s, tracks[0], tracks[1], ranges_s, 2 + 0.01 * ranges_s)
    return found


def seen(one: str, other: str, time_s: Array, sigma_m: float = 0.1) -> Estimate:
    """Where one truly sees the other."""
    (here, heading), (there, turned) = at(one, time_s), at(other, time_s)
    apart = (there - here) * np.exp(-1j * heading)
    psi = np.angle(np.exp(1j * (turned - heading)))
    spread = np.tile(sigma_m**2 * np.eye(3), (len(time_s), 1, 1))
    status = np.full(len(time_s), OK, np.int8)
    state = np.column_stack([apart.real, apart.imag, psi])
    return Estimate(time_s, state, spread, status, np.zeros(len(GLOBALS)), NoiseModel())


FLIGHT = build_swarm_problem(pairs(), {})


def test_a_swarm_is_cut_where_all_robots_were_measured() -> None:
    errors = {("a", "b"): replace(seen("a", "b", np.array([5.0, 45.0])), range_error_m=np.ones(2))}
    flight = build_swarm_problem(pairs(), errors)
    assert flight.names == list(NAMES)
    assert flight.keyframe_s == pytest.approx(6 + np.arange(381) / 10)
    step = np.array([0.1])
    for name, moves, (heading, place) in zip(NAMES, flight.motions, flight.paths, strict=True):
        speed, turn = MOTION[name]
        wanted = complex((speed * (np.exp(1j * turn * step) - 1) / (1j * turn))[0])
        shift = moves.shift_m[:, 0] + 1j * moves.shift_m[:, 1]
        assert shift == pytest.approx(np.full(380, wanted), abs=1e-4)
        assert moves.turn_rad == pytest.approx(turn * 0.1)
        where = place[:, 0] + 1j * place[:, 1]
        there, turned = at(name, flight.keyframe_s)
        back = np.exp(1j * (heading[0] - turned[0]))
        assert where - where[0] == pytest.approx((there - there[0]) * back, abs=1e-3)
        assert heading - heading[0] == pytest.approx(turned - turned[0])
    assert flight.dropout_s.sum(axis=1) == pytest.approx([0, 2, 0], abs=0.02)
    silent = flight.keyframe_s[:-1][flight.dropout_s[1] > 0]
    assert silent[[0, -1]] == pytest.approx([20, 22], abs=0.11)
    for link, names in zip(flight.links, TIME_S, strict=True):
        assert link.robots == (NAMES.index(names[0]), NAMES.index(names[1]))
        pair = pairs()[names]
        inside = (pair.range_time_s >= 6) & (pair.range_time_s <= flight.keyframe_s[-1])
        at_s = pair.range_time_s[inside]
        off = 1.0 if names == ("a", "b") else 0.0
        assert link.range_m == pytest.approx(2 + 0.01 * at_s - off)
        since = at_s - flight.keyframe_s[link.keyframe]
        assert (since >= -1e-9).all() and (since < 0.1 + 1e-9).all()
        for name, shift_m in zip(names, (link.own_shift_m, link.peer_shift_m), strict=True):
            speed, turn = MOTION[name]
            wanted = speed * (np.exp(1j * turn * since) - 1) / (1j * turn)
            assert shift_m[:, 0] + 1j * shift_m[:, 1] == pytest.approx(wanted, abs=1e-4)
        one, other = (NAMES.index(name) for name in names)
        assert link.height_m == pytest.approx(other - one + 0.01 * at_s * (other - one))


def test_a_swarm_knows_of_its_sensors_what_its_pairs_know() -> None:
    assert np.isinf(FLIGHT.calibrated_std).all()
    known, usual = pairs(), np.full(len(GLOBALS), np.inf)
    for number, names in enumerate(TIME_S):
        # A robot's own constants are the same in each of its pairs; one pair knows nothing of them.
        std = usual if number == 0 else 0.001 * (1 + np.arange(len(GLOBALS)))
        known[names] = replace(known[names], calibrated_std=std)
    robots, links = np.split(
        build_swarm_problem(known, {}).calibrated_std, [CONSTANTS_PER_ROBOT * len(NAMES)]
    )
    # a is the observer of a, c; b that of b, c; c the peer of both.
    own, peer = [0.003, 0.005, 0.007, 0.008], [0.004, 0.006, 0.009, 0.010]
    assert robots.reshape(-1, CONSTANTS_PER_ROBOT) == pytest.approx(np.array([own, own, peer]))
    nothing, both = [np.inf, np.inf], [0.001, 0.002]
    assert links.reshape(-1, CONSTANTS_PER_LINK) == pytest.approx(np.array([nothing, both, both]))


def test_a_swarm_starts_where_its_surest_pairs_say() -> None:
    key_s = FLIGHT.keyframe_s
    sigma_m = {("a", "b"): 0.1, ("b", "c"): 0.2, ("a", "c"): 0.9}
    estimates = {}
    for names in permutations(NAMES, 2):
        sure = sigma_m.get(names, sigma_m.get(names[::-1], 0.0))
        estimates[names] = seen(*names, key_s[::2], sure)
    unsure = estimates["a", "c"]
    estimates["a", "c"] = replace(unsure, state=unsure.state + 5.0)  # nobody asks it
    state = _initial_state(FLIGHT, estimates)
    heading, place = FLIGHT.paths[0]
    here, turned = at("a", key_s)
    frame = np.exp(1j * (heading - turned))
    for k, name in enumerate(NAMES):
        there, pointing = at(name, key_s)
        wanted = place[:, 0] + 1j * place[:, 1] + (there - here) * frame
        assert state[:, k, 0] + 1j * state[:, k, 1] == pytest.approx(wanted, abs=0.01)
        off = state[:, k, 2] - (pointing - turned + heading)
        assert np.abs(np.angle(np.exp(1j * off))).max() < 1e-6
        assert np.abs(np.diff(state[:, k, 2])).max() < 0.1  # no jump by a turn
        assert not state[:, k, 3:].any()


def test_a_place_in_another_s_frame_varies_as_both_do() -> None:
    rng = np.random.default_rng(2)
    state = rng.normal(size=(4, 3, STATES_PER_ROBOT))
    root = rng.normal(size=(4, 3 * STATES_PER_ROBOT, 3 * STATES_PER_ROBOT))
    spread = root @ root.swapaxes(1, 2)
    for one, other in permutations(range(3), 2):
        found, covariance = _relative_pose(state, spread, one, other)
        here = state[:, one, 0] + 1j * state[:, one, 1]
        there = state[:, other, 0] + 1j * state[:, other, 1]
        apart = (there - here) * np.exp(-1j * state[:, one, 2])
        assert found[:, 0] + 1j * found[:, 1] == pytest.approx(apart)
        assert found[:, 2] == pytest.approx(state[:, other, 2] - state[:, one, 2])
        slopes = np.zeros((4, 3, 3 * STATES_PER_ROBOT))
        for column in range(3 * STATES_PER_ROBOT):
            change = 1e-6 * (np.arange(3 * STATES_PER_ROBOT) == column).reshape(3, STATES_PER_ROBOT)
            ahead, behind = (
                _relative_pose(state + sign * change, spread, one, other)[0] for sign in (1, -1)
            )
            slopes[:, :, column] = (ahead - behind) / 2e-6
        wanted = slopes @ spread @ slopes.swapaxes(1, 2)
        assert covariance == pytest.approx(wanted, rel=1e-5, abs=1e-5)


def test_how_much_a_robot_moved_is_its_speed_s_square() -> None:
    for number, name in enumerate(NAMES):
        assert _motion_energy(FLIGHT, number) == pytest.approx(abs(MOTION[name][0]) ** 2, rel=0.05)


def test_who_is_silent_or_stands_still_is_not_ok_and_says_why() -> None:
    time_s = FLIGHT.keyframe_s
    found, silent = seen("a", "b", time_s, 0.05), (time_s > 20) & (time_s < 22)
    flown = with_status(found, silent, None, 0.3)
    assert (flown.status == np.where(silent, UNCONVERGED, OK)).all()
    assert flown.rejection_reason is None
    still = with_status(found, silent, insufficient_excitation(0.01, np.inf), 0.3)
    assert (still.status == AMBIGUOUS).all()
    assert still.rejection_reason == "still"
    assert (
        with_status(found, silent, insufficient_excitation(0.1, 0.01), 0.3).rejection_reason
        == "alike"
    )
    assert (
        with_status(found, time_s > 0, insufficient_excitation(0.1, np.inf), 0.3).rejection_reason
        == "silent"
    )
    vague = with_status(seen("a", "b", time_s, 0.4), silent, None, 0.3)
    assert vague.rejection_reason in ("open", "imprecise")


def test_silent_ranges_and_heights_are_in_all_robots_statuses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is checked is what a pair's log says; the solve itself stands in for the truth."""
    measured, truth = pairs(), {}
    for names in permutations(NAMES, 2):
        truth[names] = seen(*names, FLIGHT.keyframe_s)
    ab = measured["a", "b"]
    heard = (ab.range_time_s < 30) | (ab.range_time_s > 33)
    measured["a", "b"] = replace(ab, range_time_s=ab.range_time_s[heard], range_m=ab.range_m[heard])
    ac = measured["a", "c"]
    over = (ac.time_s > 35) & (ac.time_s < 37)
    measured["a", "c"] = replace(ac, peer=replace(ac.peer, height_dropout=over))
    state = np.zeros((len(FLIGHT.keyframe_s), 3, STATES_PER_ROBOT))
    for k, name in enumerate(NAMES):
        place, heading = at(name, FLIGHT.keyframe_s)
        state[:, k, 0], state[:, k, 1], state[:, k, 2] = place.real, place.imag, heading
    sizes = 3 * CONSTANTS_PER_ROBOT + 3 * CONSTANTS_PER_LINK
    spread = np.tile(1e-4 * np.eye(3 * STATES_PER_ROBOT), (len(state), 1, 1))
    monkeypatch.setattr(swarm, "solve", lambda *_: SwarmEstimate(state, np.zeros(sizes), 0.0))
    monkeypatch.setattr(swarm, "marginals", lambda *_: spread)
    out = estimate_swarm(measured, truth)
    for names, start_s, end_s in ((("b", "a"), 30, 33), (("c", "a"), 35, 37)):
        silent = out[names].status != OK
        wanted = (FLIGHT.keyframe_s > start_s + 0.1) & (FLIGHT.keyframe_s < end_s - 0.1)
        assert silent[wanted].all()
    away = (FLIGHT.keyframe_s > 23) & (FLIGHT.keyframe_s < 34.5)
    assert (out["a", "c"].status[away] == OK).all()


def test_constants_of_a_pair_are_its_own() -> None:
    values = np.arange(1.0, 3 * CONSTANTS_PER_ROBOT + 3 * CONSTANTS_PER_LINK + 1)
    found = SwarmEstimate(np.zeros((1, 3, STATES_PER_ROBOT)), values, 0.0)
    for one, other in permutations(range(3), 2):
        out = _pair_constants(FLIGHT, found, one, other)
        assert (out[OWN_GYRO], out[PEER_GYRO]) == (
            values[one * CONSTANTS_PER_ROBOT],
            values[other * CONSTANTS_PER_ROBOT],
        )
        number = [set(link.robots) for link in FLIGHT.links].index({one, other})
        assert out[RANGE_BIAS] == values[3 * CONSTANTS_PER_ROBOT + number * CONSTANTS_PER_LINK]
        assert np.count_nonzero(out) == 3


def test_a_calm_swarm_moves_as_it_did_where_there_is_no_noise() -> None:
    def straight(flight: SwarmProblem) -> Array:
        state = np.zeros((len(flight.keyframe_s), 3, STATES_PER_ROBOT))
        for k, speed in enumerate((0.3 + 0.1j, -0.2 + 0.3j, 0.1 - 0.4j)):
            way = k + speed * (flight.keyframe_s - 6)
            state[:, k, 0], state[:, k, 1], state[:, k, 2:] = way.real, way.imag, 0.5 + k
        return state

    state = straight(FLIGHT)
    assert _denoise_paths(FLIGHT, state, 0.0) == pytest.approx(state)
    calm = _denoise_paths(FLIGHT, state, 0.01)
    assert (calm[:, :, 2:] == state[:, :, 2:]).all()
    assert calm[..., :2].mean(axis=0) == pytest.approx(state[..., :2].mean(axis=0))
    steps, slow = (np.linalg.norm(np.diff(s[..., :2], axis=0), axis=2) for s in (state, calm))
    assert (slow < steps).all() and (slow > 0.5 * steps).all()
