"""Estimate all robots of a flight in one frame, from all their ranges at once.

The solutions of the pairs are the initial guess. A third robot often resolves a bearing that a pair
leaves open: its ranges cross theirs, and each robot's odometry enters once instead of in each pair.
"""

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import uniform_filter1d

from dmrl.estimation.flight.pairs import insufficient_excitation, with_status
from dmrl.estimation.flight.segments import is_inconsistent
from dmrl.estimation.model.gate import GATE_M
from dmrl.estimation.model.odometry import QUARTER_TURN, preintegrate, rotate, rotation_matrix
from dmrl.estimation.model.pair import GLOBALS_FROM_PEER, Array, Pair, SensorTrack
from dmrl.estimation.solver.covariance import (
    MOTION_WINDOW_S,
    shrink_to_signal,
    velocity_noise_power,
)
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import GLOBALS, KEYFRAME_HZ, odometry_dropout, range_dropout
from dmrl.estimation.solver.multi_robot import (
    CONSTANTS_PER_LINK,
    CONSTANTS_PER_ROBOT,
    STATES_PER_ROBOT,
    RangeLink,
    SwarmEstimate,
    SwarmProblem,
    marginals,
    solve,
)
from dmrl.estimation.solver.residuals import (
    OBSERVER_CONSTANTS,
    OWN_GYRO,
    PEER_GYRO,
    RANGE_BIAS,
    RANGE_SCALE,
)

Names = tuple[str, str]
MIN_SHARED_S = 5.0
"""Shortest time with data of all robots that is solved, seconds. No record of how the value was
chosen."""


def estimate_swarm(
    pairs: Mapping[Names, Pair], estimates: Mapping[Names, Estimate], *, gate_m: float = GATE_M
) -> dict[Names, Estimate]:
    """Estimate every ordered pair; robots in no group of three keep their estimates.

    Parameters
    ----------
    pairs
        Sensor data, each pair once. A robot's log is the same in all of them.
    estimates
        Estimates of every ordered pair, by pairs.
    gate_m
        Largest error of a good position, metres.
    """
    out = dict(estimates)
    for group in _find_groups(pairs):
        mine = {names: pair for names, pair in pairs.items() if names[0] in group}
        shared_s = min(p.time_s[-1] for p in mine.values()) - max(
            p.time_s[0] for p in mine.values()
        )
        if len(group) > 2 and shared_s >= MIN_SHARED_S:
            theirs = {names: e for names, e in estimates.items() if names[0] in group}
            together = _estimate_group(mine, theirs, gate_m)
            # An error without a model bends the joint solve, which then contradicts a pair.
            bent = any(is_inconsistent(together[names], found) for names, found in theirs.items())
            out |= {} if bent else together
    return out


def _find_groups(pairs: Mapping[Names, Pair]) -> list[set[str]]:
    """Return groups of robots that ranges connect."""
    groups: list[set[str]] = []
    for names in pairs:
        touched = [group for group in groups if group & set(names)]
        groups = [group for group in groups if group not in touched]
        groups.append(set(names).union(*touched))
    return groups


def _estimate_group(
    pairs: Mapping[Names, Pair], estimates: Mapping[Names, Estimate], gate_m: float
) -> dict[Names, Estimate]:
    """Return the estimates of one group, from the solve over all its robots."""
    flight = build_swarm_problem(pairs, estimates)
    # The noise model is that of the pair with the median velocity noise.
    ordered = sorted(estimates.values(), key=lambda estimate: estimate.noise.velocity_std_mps)
    noise = ordered[len(ordered) // 2].noise
    found = solve(flight, noise, _initial_state(flight, estimates))
    spread = marginals(
        flight, noise, found, _denoise_paths(flight, found.state, velocity_noise_power(noise))
    )
    place = {name: number for number, name in enumerate(flight.names)}
    out = {}
    for one, other in estimates:
        state, covariance = _relative_pose(found.state, spread, place[one], place[other])
        constants = _pair_constants(flight, found, place[one], place[other])
        none = np.zeros(len(state), np.int8)
        seen = Estimate(flight.keyframe_s, state, covariance, none, constants, noise)
        pair = pairs[one, other] if (one, other) in pairs else pairs[other, one]
        # A third robot resolves two that move alike, so only the own motion is tested.
        why = insufficient_excitation(_motion_energy(flight, place[one]), np.inf)
        silent = odometry_dropout(pair, flight.keyframe_s) | range_dropout(pair, flight.keyframe_s)
        out[one, other] = with_status(seen, silent, why, gate_m)
    return out


def build_swarm_problem(
    pairs: Mapping[Names, Pair], estimates: Mapping[Names, Estimate]
) -> SwarmProblem:
    """Build the keyframes of the time that all robots share.

    Parameters
    ----------
    pairs, estimates
        As in `estimate_swarm`.
    """
    start_s = max(pair.time_s[0] for pair in pairs.values())
    end_s = min(pair.time_s[-1] for pair in pairs.values())
    key_s = start_s + np.arange(int((end_s - start_s) * KEYFRAME_HZ + 1e-6) + 1) / KEYFRAME_HZ
    logs: dict[str, tuple[Array, SensorTrack]] = {}
    for (one, other), pair in pairs.items():
        logs |= {one: (pair.time_s, pair.own), other: (pair.time_s, pair.peer)}
    names = sorted(logs)
    ways = {name: preintegrate(track, time_s) for name, (time_s, track) in logs.items()}
    gaps = [
        np.diff(np.interp(key_s, time_s, np.cumsum(track.dropout) * (time_s[1] - time_s[0])))
        for time_s, track in (logs[name] for name in names)
    ]
    links = []
    for (one, other), pair in pairs.items():
        inside = (pair.range_time_s >= key_s[0]) & (pair.range_time_s <= key_s[-1])
        at_s = pair.range_time_s[inside]
        key = np.clip(np.searchsorted(key_s, at_s, "right") - 1, 0, len(key_s) - 1)
        shifts = [ways[name].relative_motion(key_s[key], at_s).shift_m for name in (one, other)]
        height_m = np.interp(at_s, pair.time_s, pair.peer.height_m - pair.own.height_m)
        both = names.index(one), names.index(other)
        # An obstacle lengthens ranges for seconds. The pair's solve has estimated the excess.
        range_m = pair.range_m[inside] - _range_error(estimates.get((one, other)), at_s)
        links.append(RangeLink(both, key, range_m, shifts[0], shifts[1], height_m))
    moves = [ways[name].relative_motion(key_s[:-1], key_s[1:]) for name in names]
    paths = [ways[name].interpolate_at(key_s)[:2] for name in names]
    return SwarmProblem(
        names, key_s, moves, paths, np.array(gaps), links, _collect_calibrated_std(names, pairs)
    )


def _collect_calibrated_std(names: list[str], pairs: Mapping[Names, Pair]) -> Array:
    """Return (4 N + 2 L,) standard deviations of the constants from the pairs, in swarm order."""
    robots = np.full((len(names), CONSTANTS_PER_ROBOT), np.inf)
    shared = np.full((len(pairs), CONSTANTS_PER_LINK), np.inf)
    for number, (both, pair) in enumerate(pairs.items()):
        if pair.calibrated_std is None:
            continue
        for name, known in zip(
            both, (pair.calibrated_std, pair.calibrated_std[GLOBALS_FROM_PEER]), strict=True
        ):
            mine = robots[names.index(name)]
            mine[:] = np.minimum(mine, known[OBSERVER_CONSTANTS])
        shared[number] = pair.calibrated_std[[RANGE_BIAS, RANGE_SCALE]]
    return np.concatenate([robots.ravel(), shared.ravel()])


def _range_error(estimate: Estimate | None, at_s: Array) -> Array:
    """Return (R,) range errors of the pair's own solve, metres."""
    if estimate is None or estimate.range_error_m is None:
        return np.zeros(len(at_s))
    return np.interp(at_s, estimate.time_s, estimate.range_error_m)


def _initial_state(flight: SwarmProblem, estimates: Mapping[Names, Estimate]) -> Array:
    """Return (K, N, 5) states from the pairs' solutions, along the tree of smallest sigmas."""
    sigma_m = {
        names: float(np.median(np.linalg.eigvalsh(e.covariance[:, :2, :2])[:, -1]))
        for names, e in estimates.items()
    }
    state = np.zeros((len(flight.keyframe_s), len(flight.names), STATES_PER_ROBOT))
    heading, position = flight.paths[0]
    state[:, 0, :2], state[:, 0, 2] = position, heading
    done = {flight.names[0]}
    while len(done) < len(flight.names):
        open_ends = [names for names in estimates if names[0] in done and names[1] not in done]
        one, other = min(open_ends, key=lambda names: sigma_m[names])
        here = state[:, flight.names.index(one)]
        found = estimates[one, other]
        columns = np.column_stack([found.state[:, :2], np.unwrap(found.state[:, 2])])
        x, y, psi = (np.interp(flight.keyframe_s, found.time_s, column) for column in columns.T)
        away = rotate(rotation_matrix(here[:, 2]), np.column_stack([x, y]))
        there = flight.names.index(other)
        state[:, there, :2], state[:, there, 2] = here[:, :2] + away, here[:, 2] + psi
        done.add(other)
    return state


def _denoise_paths(flight: SwarmProblem, state: Array, energy: float) -> Array:
    """Return the states on paths without probable noise, own and relative."""
    step_s = float(np.median(np.diff(flight.keyframe_s)))
    velocity = np.diff(state[:, :, :2], axis=0) / step_s
    robots = range(len(flight.names))
    own = np.stack([shrink_to_signal(velocity[:, k], energy, step_s) for k in robots], axis=1)
    mean = own.mean(axis=1, keepdims=True)
    apart = np.stack([shrink_to_signal((own - mean)[:, k], energy, step_s) for k in robots], axis=1)
    path = np.concatenate([np.zeros((1, *own.shape[1:])), np.cumsum(mean + apart, axis=0)])
    path *= step_s
    calm = state.copy()
    calm[:, :, :2] = path + state[:, :, :2].mean(axis=0) - path.mean(axis=0)
    return calm


def _relative_pose(state: Array, spread: Array, one: int, other: int) -> tuple[Array, Array]:
    """Return the pose (K, 3) of a robot in another's horizontal frame, and its covariance."""
    here, there = state[:, one], state[:, other]
    back = rotation_matrix(-here[:, 2])
    xy = rotate(back, there[:, :2] - here[:, :2])
    by_both = np.zeros((len(state), 3, 6))
    by_both[:, :2, :2], by_both[:, :2, 3:5], by_both[:, :2, 2] = -back, back, -xy @ QUARTER_TURN.T
    by_both[:, 2, 2], by_both[:, 2, 5] = -1.0, 1.0
    at = np.concatenate(
        [one * STATES_PER_ROBOT + np.arange(3), other * STATES_PER_ROBOT + np.arange(3)]
    )
    covariance = by_both @ spread[:, at[:, None], at] @ by_both.swapaxes(1, 2)
    return np.column_stack([xy, there[:, 2] - here[:, 2]]), covariance


def _motion_energy(flight: SwarmProblem, robot: int) -> float:
    """Return the mean square of a robot's averaged velocity, (m/s)^2."""
    step_s = float(np.median(np.diff(flight.keyframe_s)))
    velocity = np.diff(flight.paths[robot][1], axis=0) / step_s
    slow = uniform_filter1d(velocity, round(MOTION_WINDOW_S / step_s), axis=0, mode="nearest")
    return float((slow**2).sum(axis=1).mean())


def _pair_constants(flight: SwarmProblem, found: SwarmEstimate, one: int, other: int) -> Array:
    """Return (G,) constants of a pair in the order of ``GLOBALS``; zeros where not estimated."""
    out = np.zeros(len(GLOBALS))
    out[OWN_GYRO], out[PEER_GYRO] = found.constants[
        [one * CONSTANTS_PER_ROBOT, other * CONSTANTS_PER_ROBOT]
    ]
    for number, link in enumerate(flight.links):
        if set(link.robots) == {one, other}:
            out[RANGE_BIAS] = found.constants[
                len(flight.names) * CONSTANTS_PER_ROBOT + number * CONSTANTS_PER_LINK
            ]
    return out
