"""Find the modes of a pair: solve likely tracks, then mirrored copies of the best solution.

The search runs on a coarse copy of the flight: one averaged range per keyframe, and velocity noise
as white noise. Its solutions start the full solve.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from dmrl.estimation.model.odometry import QUARTER_TURN, rotate, rotation_matrix
from dmrl.estimation.model.pair import Array
from dmrl.estimation.search.hypotheses import Track, choose_starts, follow_hypotheses
from dmrl.estimation.solver.keyframes import average_ranges
from dmrl.estimation.solver.layout import Layout
from dmrl.estimation.solver.levenberg_marquardt import (
    ROUGH_TOLERANCE,
    MapEstimate,
    Solver,
    is_same_solution,
    relative_path,
)
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Values
from dmrl.estimation.solver.unknowns import YAW_RATE_ERROR, with_rows, without_rows

MAX_SOLVED, MAX_DEFICIT = 6, 100.0
"""Largest number of tracks that are solved, and largest log likelihood below the best of one."""
RANGE_EXCESS_M, MIN_GAIN, CLOSE_SHARE, CLOSE_M = -0.4, 10.0, 0.05, 0.6
"""Range offset that is tried, metres; gain of the log likelihood that accepts it; and the share of
ranges below a distance, metres, at which it is tried. Ranges that are too short make passing robots
seem to meet, and no solve recovers from a path around the observer. Chosen on 24 simulated harsh
flights, of which three had ended there."""
MAX_PASS_M, FLIP_WIDTH_M, MAX_COPIES = 0.5, 0.4, 8
"""Largest distance of a pass that leaves the side of the peer open, metres; increase of the
distance at which a flipped side begins and ends, metres; largest number of copies."""
SAME_TRACK_M = 0.2
"""Largest distance between two paths that are the same mode, metres. A pass on the other side
differs by more."""
MIN_COST_GAIN = 0.5
"""Smallest cost reduction that makes a solution a new one."""
MODE_COST_MARGIN, MAX_MODES = 12.0, 4
"""Largest cost above the best, and largest number, of the modes of a flight that are kept. A
mode 12 above the best has 5 % of its weight at the cost scale of 4."""
MAX_FLEXIBLE = 2
"""Largest number of solutions with changing yaw rate biases from which error models are solved."""
COST_SCALE = 4.0
"""Cost difference at which a mode has 1 / e of the weight of the best one. Costs differ by this
much without reason, because losses and noise model are approximations."""


def coarsen(problem: Problem) -> Problem:
    """Return the coarse copy of a flight: averaged ranges, white velocity noise."""
    white = replace(problem.noise, velocity_psd=problem.velocity_psd / problem.noise.grade**2)
    links = tuple(average_ranges(link, problem.keyframe_s) for link in problem.links)
    table = without_rows(problem.table, ("velocity_error_x", "velocity_error_y"))
    return replace(problem, links=links, table=table, noise=white)


def convert_values(values: Values, before: Layout, after: Layout) -> Values:
    """Return values in another layout; 0 for unknowns that only it has."""
    state = np.zeros((len(values.state), after.width))
    state[:, : 3 * before.robots] = values.state[:, : 3 * before.robots]
    for k, (subject, _) in enumerate(after.states):
        column = before.state_column(subject[0], *subject[1])
        if column is not None:
            state[:, 3 * after.robots + k] = values.state[:, column]
    known = {subject: values.constants[k] for k, (subject, _) in enumerate(before.constants)}
    return Values(state, np.array([known.get(s, 0.0) for s, _ in after.constants]))


def place_peer(problem: Problem, pose: Array, bias: Array) -> Values:
    """Return values with the peer at relative poses, and the observer on its dead reckoning.

    Parameters
    ----------
    problem
        Flight of two robots.
    pose
        (K, 3) x, y, psi of the peer in the observer's horizontal frame.
    bias
        (2,) biases of both yaw rates, rad/s.
    """
    layout, steps = problem.layout, problem.robots[0]
    turn = steps.motion.turn_rad - bias[0] * steps.steps_s
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    moved = rotate(rotation_matrix(heading[:-1]), steps.motion.shift_m)
    state, constants = np.zeros((len(pose), layout.width)), np.zeros(len(layout.constants))
    state[1:, :2], state[:, 2] = np.cumsum(moved, axis=0), heading
    state[:, 3:5] = state[:, :2] + rotate(rotation_matrix(heading), pose[:, :2])
    state[:, 5] = heading + pose[:, 2]
    for robot in range(2):
        if ("gyro_bias", (robot,)) in [subject for subject, _ in layout.constants]:
            constants[layout.find("gyro_bias", robot)] = bias[robot]
    return Values(state, constants)


def find_flexible_modes(problem: Problem, tracks: Sequence[Track]) -> list[Values]:
    """Find solutions under yaw rate biases that change, in the layout of the problem.

    A flight whose gyroscope drifts has no good solution with constant biases.

    Parameters
    ----------
    problem
        Flight of two robots with its noise.
    tracks
        Its tracks.
    """
    flexible = replace(problem, table=with_rows(problem.table, YAW_RATE_ERROR))
    modes = find_modes(flexible, tracks)[:MAX_FLEXIBLE]
    layout = coarsen(flexible).layout
    return [convert_values(mode.values, layout, problem.layout) for mode in modes]


def find_modes(problem: Problem, tracks: Sequence[Track] | None = None) -> list[MapEstimate]:
    """Find the modes of a flight of two robots, best first.

    Parameters
    ----------
    problem
        The flight.
    tracks
        Its tracks, best first. None: searched.

    Returns
    -------
    list
        Distinct solutions of the coarse copy (`coarsen`), within a margin of the best.
    """
    coarse = coarsen(problem)
    solver = Solver(coarse)
    tracks = tracks or find_tracks(problem)
    starts = [_composite(tracks, choose_starts(problem.keyframe_s))]
    starts += [track for track in tracks if track.score > tracks[0].score - MAX_DEFICIT]
    found: list[MapEstimate] = []
    begun: list[Values] = []
    for track in starts:
        values = place_peer(coarse, track.pose, track.gyro_bias_radps)
        if track.range_excess_m:
            values.constants[coarse.layout.find("range_offset", 0, 1)] = track.range_excess_m
        if not any(is_same_solution(values, other, SAME_TRACK_M) for other in begun):
            begun.append(values)
            found.append(solver.solve(values, found, ROUGH_TOLERANCE, SAME_TRACK_M))
        if len(begun) == MAX_SOLVED:
            break
    best = min(found, key=lambda mode: mode.cost)
    # A solve may stick where its constants ran away; it succeeds from zero constants.
    fresh = Values(best.values.state.copy(), np.zeros_like(best.values.constants))
    fresh.state[:, 3 * coarse.layout.robots :] = 0.0
    found.append(solver.solve(fresh, found, ROUGH_TOLERANCE, SAME_TRACK_M))
    return select_modes(_mirror_passes(solver, found))


def dead_reckon(problem: Problem, first: Array) -> Values:
    """Return values with both robots on their dead reckoning.

    Parameters
    ----------
    problem
        The flight.
    first
        (n + G,) values of the first keyframe and of the constants.
    """
    layout = problem.layout
    state = np.zeros((len(problem.keyframe_s), layout.width))
    for robot, steps in enumerate(problem.robots):
        x, y, theta = layout.pose(robot)
        heading = first[theta] + np.concatenate([[0.0], np.cumsum(steps.motion.turn_rad)])
        moved = rotate(rotation_matrix(heading[:-1]), steps.motion.shift_m)
        state[:, [x, y]] = first[[x, y]] + np.concatenate([np.zeros((1, 2)), moved.cumsum(axis=0)])
        state[:, theta] = heading
    return Values(state, first[layout.width :])


def find_tracks(problem: Problem) -> list[Track]:
    """Return the tracks of a flight, best first; with longer ranges if these are far likelier."""
    tracks, ranges = follow_hypotheses(problem), problem.links[0].range_m
    if len(ranges) and np.quantile(ranges, CLOSE_SHARE) < CLOSE_M:
        longer = follow_hypotheses(problem, RANGE_EXCESS_M)
        if longer[0].score > tracks[0].score + MIN_GAIN:
            return longer
    return tracks


def _composite(tracks: Sequence[Track], starts: NDArray[np.intp]) -> Track:
    """Return the track that consists of the likeliest one between any two starts."""
    edges = [*starts.tolist(), len(tracks[0].pose)]
    pose, score = tracks[0].pose.copy(), np.zeros(len(tracks[0].pose))
    for first, end in pairwise(edges):
        best = max(tracks, key=lambda track: float(track.log_likelihood[first:end].sum()))
        pose[first:end], score[first:end] = best.pose[first:end], best.log_likelihood[first:end]
        if first:
            turns = np.round((pose[first, 2] - pose[first - 1, 2]) / (2 * np.pi))
            pose[first:end, 2] -= 2 * np.pi * turns
    return replace(tracks[0], pose=pose, log_likelihood=score)


def select_modes(found: Sequence[MapEstimate]) -> list[MapEstimate]:
    """Return the distinct solutions within a cost margin of the best, best first."""
    ordered = sorted(found, key=lambda mode: mode.cost)
    out: list[MapEstimate] = []
    for one in ordered:
        close = one.cost <= ordered[0].cost + MODE_COST_MARGIN
        if close and not any(
            is_same_solution(one.values, other.values, SAME_TRACK_M) for other in out
        ):
            out.append(one)
    return out[:MAX_MODES]


def mode_weights(modes: Sequence[MapEstimate]) -> Array:
    """Return (M,) weights of the modes by their costs, with sum 1."""
    cost = np.array([mode.cost for mode in modes])
    weight = np.exp((cost.min() - cost) / COST_SCALE)
    return np.asarray(weight / weight.sum())


def _mirror_passes(solver: Solver, found: Sequence[MapEstimate]) -> list[MapEstimate]:
    """Return the solutions, with those that mirrored copies of the best one lead to."""
    found, best, tried = list(found), None, 0
    rate_hz = 1 / float(np.median(np.diff(solver.problem.keyframe_s)))
    while best is None or min(mode.cost for mode in found) < best.cost - MIN_COST_GAIN:
        best = min(found, key=lambda mode: mode.cost)
        path = relative_path(best.values.state)
        for copy in mirror_copies(path, rate_hz)[: MAX_COPIES - tried]:
            tried += 1
            state = best.values.state.copy()
            here = state[:, :3]
            state[:, 3:5] = here[:, :2] + rotate(rotation_matrix(here[:, 2]), copy[:, :2])
            start = Values(state, best.values.constants)
            found.append(solver.solve(start, found, ROUGH_TOLERANCE, SAME_TRACK_M))
            if found[-1].cost < best.cost - MIN_COST_GAIN:
                break
    return found


def mirror_copies(path: Array, rate_hz: float) -> list[Array]:
    """Return copies of a relative path with the other side of close passes.

    Each pass is flipped by itself, nearest first. Each segment between two passes is mirrored,
    shortest first.

    Parameters
    ----------
    path
        (K, 3) x, y (m), psi (rad).
    rate_hz
        Keyframes per second.
    """
    distance = np.hypot(*path[:, :2].T)
    least = minimum_filter1d(distance, 2 * round(rate_hz) + 1)
    passes = np.flatnonzero((distance == least) & (distance < MAX_PASS_M))
    out = []
    for at in passes[np.argsort(distance[passes])].tolist():
        farther = np.flatnonzero(distance > distance[at] + FLIP_WIDTH_M)
        start = int(farther[farther < at].max(initial=-1)) + 1
        end = int(farther[farther > at].min(initial=len(path)))
        # Fully mirrored at the closest point and gradually less away from it, without a jump.
        near = np.cos((distance[start:end] - distance[at]) / FLIP_WIDTH_M * np.pi / 2)
        out.append(_mirror(path, start, end, (at - 1, at + 1), near))
    for start, end in sorted(pairwise(passes.tolist()), key=lambda ends: ends[1] - ends[0]):
        half = round(rate_hz / 2)
        out.append(_mirror(path, start, end, (end - half, end + half), np.ones(end - start)))
    return out


def _mirror(path: Array, start: int, end: int, way: tuple[int, int], share: Array) -> Array:
    """Mirror a segment at the line of motion between two keyframes."""
    first, last = np.clip(way, 0, len(path) - 1)
    along = path[last, :2] - path[first, :2]
    aside = QUARTER_TURN @ along / max(float(np.hypot(*along)), 1e-6)
    copy = path.copy()
    # p - 2 (n p) n keeps the ranges and changes the odometry.
    copy[start:end, :2] -= np.outer(2 * share * (copy[start:end, :2] @ aside), aside)
    return copy
