"""Estimate all robots of a flight in one frame, from all their measurements at once.

The solutions of the pairs are the first guess. A third robot often resolves a bearing that a pair
leaves open: its ranges cross theirs, and each robot's odometry enters once instead of in each pair.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from scipy.special import gammaincinv

from dmrl.estimation.flight.pair_output import (
    height_errors,
    interpolate_at,
    interpolate_states,
    join_estimates,
    motion_energy,
    output_times,
    with_status,
)
from dmrl.estimation.flight.pair_solver import consistent_views
from dmrl.estimation.flight.windows import carry_information, split_windows
from dmrl.estimation.model.gate import DEFAULT_GATE, Gate
from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import Array, Mask, Pair
from dmrl.estimation.model.status import OK
from dmrl.estimation.signals.contradictions import drop_contradictions
from dmrl.estimation.solver.camera_noise import calibrate_views
from dmrl.estimation.solver.covariance import Covariances, compute_covariance
from dmrl.estimation.solver.estimate import PAIR_LAYOUT, REASONS, Estimate
from dmrl.estimation.solver.keyframes import (
    build_problem,
    list_robots,
    odometry_dropout,
    range_dropout,
)
from dmrl.estimation.solver.layout import Layout
from dmrl.estimation.solver.levenberg_marquardt import (
    ROUGH_TOLERANCE,
    Solver,
    relative_path,
)
from dmrl.estimation.solver.priors import Carried
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Values

Names = tuple[str, str]
MIN_SHARED_S = 5.0
"""Shortest time with data of all robots that is solved, seconds: that of a pair."""
MIN_RANGE_ERROR_M = 0.05
"""Temporary excess of a pair's ranges from which the joint solve estimates it too, metres: half the
noise of a range."""
CONSISTENCY_PROBABILITY, MAX_OUTSIDE_SHARE = 0.99, 0.2
"""A solution is rejected if more than the second share of another one's OK positions have it
outside their ellipse of the first probability."""


def estimate_swarm(
    pairs: Mapping[Names, Pair], estimates: Mapping[Names, Estimate], *, gate: Gate = DEFAULT_GATE
) -> dict[Names, Estimate]:
    """Estimate every ordered pair; robots in no group of three keep their estimates.

    Parameters
    ----------
    pairs
        Sensor data, each pair once. A robot's log is the same in all of them.
    estimates
        Estimates of every ordered pair, by pairs.
    gate
        Gate of the positions.
    """
    out = dict(estimates)
    for group in _find_groups(pairs):
        mine = {names: drop_contradictions(p) for names, p in pairs.items() if names[0] in group}
        start_s = max(p.time_s[0] for p in mine.values())
        end_s = min(p.time_s[-1] for p in mine.values())
        if len(group) > 2 and end_s - start_s >= MIN_SHARED_S:
            theirs = {names: e for names, e in estimates.items() if names[0] in group}
            together = _estimate_group(mine, theirs, (start_s, end_s), gate)
            # An error without a model bends the joint solve, which then contradicts a pair.
            bent = any(is_inconsistent(together[names], found) for names, found in theirs.items())
            out |= {} if bent else together
    return out


def is_inconsistent(whole: Estimate, sure: Estimate) -> bool:
    """Return whether a solution fails a chi-square test against another one's confident positions.

    Parameters
    ----------
    whole
        Solution to test.
    sure
        Another solution of the same ordered pair, of the same time or a part of it.
    """
    xy, _, _ = whole.interpolate_at(sure.time_s)
    known = sure.status == OK
    if not known.any():
        return False
    apart = (xy - sure.state[:, :2])[known]
    information = np.linalg.inv(sure.covariance[known, :2, :2])
    # Squared Mahalanobis distances are chi-square with two degrees of freedom if both are right.
    squared = np.einsum("ki,kij,kj->k", apart, information, apart)
    return bool(
        (squared > 2 * gammaincinv(1.0, CONSISTENCY_PROBABILITY)).mean() > MAX_OUTSIDE_SHARE
    )


def _find_groups(pairs: Mapping[Names, Pair]) -> list[set[str]]:
    """Return groups of robots that ranges connect."""
    groups: list[set[str]] = []
    for names in pairs:
        touched = [group for group in groups if group & set(names)]
        groups = [group for group in groups if group not in touched]
        groups.append(set(names).union(*touched))
    return groups


def _estimate_group(
    pairs: Mapping[Names, Pair],
    estimates: Mapping[Names, Estimate],
    shared_s: tuple[float, float],
    gate: Gate,
) -> dict[Names, Estimate]:
    """Return the estimates of one group, from the solve over all its robots."""
    names, parts = list_robots(pairs), list(_solve_windows(pairs, estimates, shared_s))
    out = {}
    for one, other in estimates:
        pair = pairs[one, other] if (one, other) in pairs else pairs[other, one]
        both = names.index(one), names.index(other)
        seen = join_estimates([_select_pair(part, both) for part in parts])
        energy = np.mean(
            [motion_energy(solver.problem, v, *both) for solver, v, *_ in parts], axis=0
        )
        silent: Mask = odometry_dropout(pair, seen.time_s) | range_dropout(pair, seen.time_s)
        # The reason why a pair was refused alone need not hold for the swarm.
        causes = tuple(c for c in estimates[one, other].causes if c.name not in REASONS.values())
        seen = replace(seen, causes=causes)
        out[one, other] = with_status(seen, silent, (energy[0], energy[2]), gate)
    return out


Part = tuple[Solver, Values, Covariances, Array]
"""A window: its solver, values, covariances, and output times."""


def _solve_windows(
    pairs: Mapping[Names, Pair], estimates: Mapping[Names, Estimate], shared_s: tuple[float, float]
) -> Iterator[Part]:
    """Solve all robots window by window."""
    carried: Carried | None = None
    names = list_robots(pairs)
    for window in split_windows(*shared_s):
        cut = {both: pair.crop(window.start_s, window.end_s) for both, pair in pairs.items()}
        numbered = {(names.index(a), names.index(b)): pair for (a, b), pair in cut.items()}
        problem = _with_pair_models(build_problem(numbered), names, estimates)
        start = Values(
            _initial_state(problem, names, estimates), np.zeros(len(problem.layout.constants))
        )
        views = consistent_views(problem, start)
        kept = replace(problem, views=views)
        start = Values(start.state, np.zeros(len(kept.layout.constants)))
        if kept.layout.width != problem.layout.width:
            start = Values(_initial_state(kept, names, estimates), start.constants)
        solver = Solver(kept, carried)
        solver, found = calibrate_views(solver, solver.solve(start, tolerance=ROUGH_TOLERANCE))
        values = found.values
        first = next(iter(pairs.values()))
        times = output_times(first.time_s[0], window.from_s, window.until_s)
        yield solver, values, compute_covariance(solver, values), times
        carried = None if window.is_last else carry_information(solver, values, window.next_s)


def _with_pair_models(
    problem: Problem, names: list[str], estimates: Mapping[Names, Estimate]
) -> Problem:
    """Return a flight with the noise of the median pair, and range errors where pairs have them."""
    ordered = sorted(estimates.values(), key=lambda estimate: estimate.noise.grade)
    noise = replace(ordered[len(ordered) // 2].noise, known_std=problem.noise.known_std)
    unused = set()
    for link in problem.links:
        error = estimates[names[link.robots[0]], names[link.robots[1]]].range_error_m
        if error is None or np.abs(error).max() < MIN_RANGE_ERROR_M:
            unused.add(("range_error", link.robots))
    return replace(problem, noise=noise, unused=frozenset(unused))


def _initial_state(flight: Problem, names: list[str], estimates: Mapping[Names, Estimate]) -> Array:
    """Return (K, n) states from the pairs' solutions, along the tree of smallest sigmas."""
    sigma_m = {
        both: float(np.median(np.linalg.eigvalsh(e.covariance[:, :2, :2])[:, -1]))
        for both, e in estimates.items()
    }
    key_s, layout = flight.keyframe_s, flight.layout
    state = np.zeros((len(key_s), layout.width))
    heading, position, _ = flight.robots[0].path.interpolate_at(key_s)
    state[:, :2], state[:, 2] = position, heading
    done = {names[0]}
    while len(done) < len(names):
        open_ends = [both for both in estimates if both[0] in done and both[1] not in done]
        one, other = min(open_ends, key=lambda both: sigma_m[both])
        here = state[:, layout.pose(names.index(one))]
        found = estimates[one, other]
        columns = np.column_stack([found.state[:, :2], np.unwrap(found.state[:, 2])])
        x, y, psi = (np.interp(key_s, found.time_s, column) for column in columns.T)
        there = layout.pose(names.index(other))
        away = rotate(rotation_matrix(here[:, 2]), np.column_stack([x, y]))
        state[:, there] = np.column_stack([here[:, :2] + away, here[:, 2] + psi])
        done.add(other)
    for link in flight.links:
        column = layout.state_column("range_error", *link.robots)
        error = estimates[names[link.robots[0]], names[link.robots[1]]]
        if column is not None and error.range_error_m is not None:
            state[:, column] = np.interp(key_s, error.time_s, error.range_error_m)
    return state


def _select_pair(part: Part, both: tuple[int, int]) -> Estimate:
    """Return the estimate of one ordered pair in a window, without statuses."""
    solver, values, covariances, time_s = part
    problem, key_s = solver.problem, solver.problem.keyframe_s
    spread = covariances.relative(values.state, *both)
    heights, height_std = height_errors(problem, values, covariances, both)
    return Estimate(
        time_s,
        relative_path(interpolate_states(problem, values.state, time_s), *both),
        interpolate_at(time_s, key_s, spread),
        np.zeros(len(time_s), np.int8),
        _pair_constants(problem.layout, values.constants, both),
        problem.noise,
        height_m=interpolate_at(time_s, key_s, heights),
        height_std_m=interpolate_at(time_s, key_s, height_std),
    )


def _pair_constants(layout: Layout, constants: Array, both: tuple[int, int]) -> Array:
    """Return (G,) constants of a pair in the order of ``PAIR_LAYOUT``; 0 without an estimate."""
    known = {subject: constants[k] for k, (subject, _) in enumerate(layout.constants)}
    out = np.zeros(len(PAIR_LAYOUT.constants))
    for k, ((name, own), row) in enumerate(PAIR_LAYOUT.constants):
        if row.owner == "clock":
            # The first robot's clock counts, and has no column.
            here, there = (known.get((name, (robot,)), 0.0) for robot in both)
            out[k] = there - here
        else:
            owners = tuple(sorted(both[side] for side in own))
            out[k] = known.get((name, owners), 0.0)
    return out
