"""Estimate all robots of a flight in one frame, from all their measurements at once.

Solutions of the pairs under the plain model are the first guess. A third robot often resolves a
bearing that a pair leaves open: its ranges cross theirs, and each robot's odometry enters once
instead of in each pair. Error models are tried if the plain model does not fit. A robot whose
signals no model explains is left out, and the others are solved without it.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from dmrl.estimation.evidence.clock_shifts import find_clock_shift, find_motion_shift
from dmrl.estimation.evidence.delays import SIGNALS
from dmrl.estimation.evidence.error_models import Candidate
from dmrl.estimation.evidence.goodness_of_fit import FALSE_ALARM, check_fit
from dmrl.estimation.evidence.model_trials import Member
from dmrl.estimation.evidence.noisy_stretch import sum_velocity_squares
from dmrl.estimation.evidence.posterior import Mixture, list_shown, weigh_models
from dmrl.estimation.flight.pair_output import output_times
from dmrl.estimation.flight.pair_solver import WindowSolution, consistent_views
from dmrl.estimation.flight.pairs import MIN_PRIOR_CHANCE, MISFIT_GRADE
from dmrl.estimation.flight.pieces import compute_prior_chance
from dmrl.estimation.flight.swarm_output import Names, SwarmPart, estimate_directions
from dmrl.estimation.flight.windows import Window, carry_information, split_windows
from dmrl.estimation.model.gate import DEFAULT_GATE, Gate
from dmrl.estimation.model.odometry import rotate, rotation_matrix
from dmrl.estimation.model.pair import Array, Pair
from dmrl.estimation.search.modes import convert_values
from dmrl.estimation.signals.contradictions import drop_contradictions, drop_held_ranges
from dmrl.estimation.solver.camera_noise import calibrate_views
from dmrl.estimation.solver.covariance import Covariances, compute_covariance
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import build_problem, list_robots
from dmrl.estimation.solver.levenberg_marquardt import ROUGH_TOLERANCE, MapEstimate, Solver
from dmrl.estimation.solver.priors import Carried
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Values
from dmrl.guards.memory import return_freed_memory

Progress = Callable[[Sequence[Window]], Iterable[Window]]
MIN_SHARED_SHARE = 0.95
"""Smallest share of the longest pair's time that all robots share. A robot that flies for a shorter
time is left out, as the others would lose the rest of their flight."""
MAX_MISFIT_SHARE = 0.1
"""Largest share of a window that may not fit, and is refused. Beyond it the robot is left out."""
MIN_RANGE_ERROR_M = 0.05
"""Temporary excess of a pair's ranges from which the joint solve estimates it too, metres: half the
noise of a range."""


def estimate_swarm(
    pairs: Mapping[Names, Pair],
    starts: Mapping[Names, Estimate],
    *,
    gate: Gate = DEFAULT_GATE,
    progress: Progress = iter,
) -> dict[Names, Estimate]:
    """Estimate the robots of every group of three or more that ranges connect.

    Parameters
    ----------
    pairs
        Sensor data, each pair once. A robot's log is the same in all of them.
    starts
        Estimates of every ordered pair under the plain model.
    gate
        Gate of the positions.
    progress
        Shows the progress over the windows of a group.

    Returns
    -------
    dict
        Estimates of the ordered pairs of all robots that an error model, or none, explains.
    """
    out: dict[Names, Estimate] = {}
    for group in (one for one in _find_groups(pairs) if len(one) > 2):
        mine = {names: pair for names, pair in pairs.items() if names[0] in group}
        out |= _estimate_group(mine, starts, gate, progress)
    return out


def _estimate_group(
    pairs: Mapping[Names, Pair],
    starts: Mapping[Names, Estimate],
    gate: Gate,
    progress: Progress,
) -> dict[Names, Estimate]:
    """Return the estimates of a group without the robots that no model explains."""
    if any(find_clock_shift(pair) for pair in pairs.values()):
        return {}
    used = {names: drop_contradictions(drop_held_ranges(pair)) for names, pair in pairs.items()}
    left_out = _find_shortest_log(used)
    if left_out is None:
        mine = {names: starts[names] for names in starts if {*names} <= {*list_robots(pairs)}}
        try:
            parts, fault = _solve_group(used, mine, progress)
        except np.linalg.LinAlgError:  # the pairs may have a solution each
            return {}
        if fault is None:
            return estimate_directions(pairs, used, parts, gate)
        left_out = list_robots(pairs)[fault]
    rest = {names: pair for names, pair in pairs.items() if left_out not in names}
    return estimate_swarm(rest, starts, gate=gate, progress=progress)


def _find_shortest_log(pairs: Mapping[Names, Pair]) -> str | None:
    """Return the robot whose log shortens the time of all robots most; None if all are alike."""
    ends = {
        robot: (
            # A pair ends with the shorter log, so the longest pair of a robot shows its own.
            min(pair.time_s[0] for names, pair in pairs.items() if robot in names),
            max(pair.time_s[-1] for names, pair in pairs.items() if robot in names),
        )
        for robot in list_robots(pairs)
    }
    shared_s = min(end for _, end in ends.values()) - max(start for start, _ in ends.values())
    longest_s = max(pair.time_s[-1] - pair.time_s[0] for pair in pairs.values())
    if shared_s >= MIN_SHARED_SHARE * longest_s:
        return None
    return min(ends, key=lambda robot: ends[robot][1] - ends[robot][0])


def select_connected(pairs: Mapping[Names, Pair]) -> dict[Names, Pair]:
    """Return the pairs of robots that are in a group of three or more."""
    large = [group for group in _find_groups(pairs) if len(group) > 2]
    return {n: pair for n, pair in pairs.items() if any(n[0] in group for group in large)}


def _find_groups(pairs: Mapping[Names, Pair]) -> list[set[str]]:
    """Return groups of robots that ranges connect."""
    groups: list[set[str]] = []
    for names in (names for names, pair in pairs.items() if len(pair.range_m)):
        touched = [group for group in groups if group & set(names)]
        groups = [group for group in groups if group not in touched]
        groups.append(set(names).union(*touched))
    return groups


def _solve_group(
    pairs: Mapping[Names, Pair], starts: Mapping[Names, Estimate], progress: Progress
) -> tuple[list[SwarmPart], int | None]:
    """Return the windows of one group, up to the first that no model explains, and its robot."""
    start_s = max(pair.time_s[0] for pair in pairs.values())
    end_s = min(pair.time_s[-1] for pair in pairs.values())
    windows, parts = list(split_windows(start_s, end_s)), list[SwarmPart]()
    for part in _solve_windows(pairs, starts, progress(windows)):
        parts.append(part)
        if part.fault is not None:
            return parts, part.fault
    return parts, None


def _solve_windows(
    pairs: Mapping[Names, Pair], starts: Mapping[Names, Estimate], windows: Iterable[Window]
) -> Iterator[SwarmPart]:
    """Solve all robots window by window."""
    carried: Carried | None = None
    names = list_robots(pairs)
    for window in windows:
        return_freed_memory()  # of the pairs, and of the window before
        cut = {both: pair.crop(window.start_s, window.end_s) for both, pair in pairs.items()}
        numbered = {(names.index(a), names.index(b)): pair for (a, b), pair in cut.items()}
        problem = _with_pair_models(build_problem(numbered), names, starts)
        start = _first_guess(problem, names, starts)
        kept = replace(problem, views=consistent_views(problem, start))
        start = convert_values(start, problem.layout, kept.layout)
        solver = Solver(kept, carried)
        solver, found = calibrate_views(solver, solver.solve(start, tolerance=ROUGH_TOLERANCE))
        first = next(iter(pairs.values()))
        times = output_times(first.time_s[0], window.from_s, window.until_s)
        part = _weigh_window(solver, found, times)
        yield part
        best = part.solution
        carried = (
            None if window.is_last else carry_information(best.solver, best.values, window.next_s)
        )


def _weigh_window(solver: Solver, found: MapEstimate, time_s: Array) -> SwarmPart:
    """Return a window under the plain model, or under error models where that does not fit.

    Constants of the robots are cheap to screen, and show most errors. Errors that change over time
    are tried if a constant explains something, or if the window does not fit.

    Parameters
    ----------
    solver, found
        Flight under the plain model, and its solution.
    time_s
        (T,) output times, seconds.
    """
    listed = [one for one in list_shown(solver.problem) if _suits_swarm(one)]
    constants = [one for one in listed if one.robot is not None and _is_constant(one)]
    mixture = weigh_models(solver, [found], candidates=constants)
    part = _check_window(mixture, time_s, FALSE_ALARM)
    if part.fault is None and not part.misfits and not mixture.members[0].models:
        return part
    mixture = weigh_models(solver, [found], candidates=listed)
    tried = _check_window(mixture, time_s, MIN_PRIOR_CHANCE)
    if tried.fault is None or part.fault is None:
        return tried
    # Models bend the solution, which hides the sensor that they stand for.
    return tried._replace(fault=part.fault)


def _suits_swarm(one: Candidate) -> bool:
    """Return whether a model adds no state for each pair of robots: there are too many."""
    states = [row for row in one.model.rows if not row.is_constant and row.owner == "pair"]
    return not (states or one.model.sudden or one.model.for_a_while)


def _is_constant(one: Candidate) -> bool:
    """Return whether a model adds constants alone."""
    return bool(one.model.rows) and all(row.is_constant for row in one.model.rows)


def _is_of_time(one: Candidate) -> bool:
    """Return whether a model is of a clock or of a delay, which moves samples in time."""
    return any(row.owner == "clock" or row.name in SIGNALS for row in one.model.rows)


def _check_window(mixture: Mixture, time_s: Array, least_chance: float) -> SwarmPart:
    """Return a window with the robot at fault, if its models do not explain it.

    Parameters
    ----------
    mixture
        Solutions under likely models.
    time_s
        (T,) output times, seconds.
    least_chance
        Smallest probability of the constants, by their priors, of a flight that is explained.
    """
    best = mixture.members[0]
    ends = float(time_s[0]), float(time_s[-1])
    innovations, misfits = check_fit(best.solver, best.values, ends)
    problem = best.solver.problem
    spread = [compute_covariance(one.solver, one.values) for one in mixture.members]
    # Only pairs are solved again with samples that are moved in time.
    fault = next((one.robot for one in best.models if _is_of_time(one)), None)
    fault = _find_moved_clock(best, spread[0]) if fault is None else fault
    long = sum(one.to_s - one.from_s for one in misfits) > MAX_MISFIT_SHARE * (ends[1] - ends[0])
    if fault is None and long:
        fault = max(misfits, key=lambda one: one.to_s - one.from_s).robot
    elif fault is None and (
        problem.noise.grade < MISFIT_GRADE
        and compute_prior_chance(problem, best.values) >= least_chance
    ):
        return SwarmPart(WindowSolution(mixture, spread), time_s, innovations, misfits, None)
    fault = _find_worst_robot(best) if fault is None else fault
    return SwarmPart(WindowSolution(mixture, spread), time_s, innovations, misfits, fault)


def _find_moved_clock(best: Member, spread: Covariances) -> int | None:
    """Return a robot whose clock is off, if only one robot of some pair ranges; else None."""
    problem = best.solver.problem
    if all(len(np.unique(link.sent)) != 1 or 0.0 < link.sent[0] < 1.0 for link in problem.links):
        return None
    for (_, own), row in problem.layout.constants:
        if row.owner == "clock":
            k = problem.layout.find(row.name, *own)
            offset_s, variance = best.values.constants[[k]], spread.constants[[k], k]
            if find_motion_shift(offset_s, variance, is_off=False):
                return own[0]
    return None


def _find_worst_robot(best: Member) -> int:
    """Return the robot whose odometry differs most from the solution, relative to its noise."""
    robots = range(len(best.solver.problem.robots))
    squares = [sum_velocity_squares(best.solver, best.values, robot).mean() for robot in robots]
    return int(np.argmax(squares))


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


def _first_guess(flight: Problem, names: list[str], estimates: Mapping[Names, Estimate]) -> Values:
    """Return values from the solutions of the pairs, along the tree of smallest sigmas."""
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
    return Values(state, np.zeros(len(layout.constants)))
