"""Output of a joint solve: the estimates of every ordered pair, with statuses and causes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dmrl.estimation.evidence.causes import find_causes, find_dropouts
from dmrl.estimation.flight.pair_output import (
    height_errors,
    interpolate_at,
    join_estimates,
    mix_members,
    motion_energy,
    with_status,
)
from dmrl.estimation.flight.pair_solver import WindowSolution
from dmrl.estimation.flight.pieces import find_contradicted_steps
from dmrl.estimation.model.gate import Gate
from dmrl.estimation.model.pair import Array, Mask, Pair
from dmrl.estimation.solver.estimate import PAIR_LAYOUT, Cause, Estimate, Innovation
from dmrl.estimation.solver.keyframes import list_robots, odometry_dropout, range_dropout
from dmrl.estimation.solver.layout import Layout

Names = tuple[str, str]


class SwarmPart(NamedTuple):
    """Window: its solutions under likely models, and output times.

    ``misfits`` are stretches that do not fit, ``fault`` the robot that no model explains.
    """

    solution: WindowSolution
    time_s: Array
    innovations: tuple[Innovation, ...]
    misfits: tuple[Cause, ...]
    fault: int | None


def estimate_directions(
    logged: Mapping[Names, Pair],
    used: Mapping[Names, Pair],
    parts: Sequence[SwarmPart],
    gate: Gate,
) -> dict[Names, Estimate]:
    """Return the estimates of both directions of all pairs of a group."""
    names, out = list_robots(logged), {}
    for (one, other), pair in used.items():
        both = names.index(one), names.index(other)
        sides = [
            join_estimates([_select_pair(part, turned) for part in parts])
            for turned in (both, both[::-1])
        ]
        silent = _find_silence(pair, sides[0].time_s, parts, both)
        each = [motion_energy(p.solution.problem, p.solution.values, *both) for p in parts]
        own, peer, relative = np.mean(each, axis=0)
        gaps = find_dropouts(logged[one, other], pair)
        seen_gaps = gaps, tuple(cause.seen_from_peer() for cause in gaps)
        for label, seen, found, energy in zip(
            ((one, other), (other, one)), sides, seen_gaps, (own, peer), strict=True
        ):
            seen = replace(seen, causes=(*found, *seen.causes))
            out[label] = with_status(seen, silent, (energy, relative), gate)
    return out


def _find_silence(
    pair: Pair, time_s: Array, parts: Sequence[SwarmPart], both: tuple[int, int]
) -> Mask:
    """Return (T,) whether sensors of a pair are silent or contradict the solution."""
    silent: Mask = odometry_dropout(pair, time_s)
    if len(pair.range_m):  # two robots may be placed by the ranges of others
        silent |= range_dropout(pair, time_s)
    for part in parts:
        problem, values = part.solution.problem, part.solution.values
        key_s, wrong = problem.keyframe_s, find_contradicted_steps(problem, values, both)
        step = np.searchsorted(key_s, time_s, "right") - 1
        inside = (step >= 0) & (step < len(wrong))
        silent[inside] |= wrong[step[inside]]
    return silent


def _select_pair(part: SwarmPart, both: tuple[int, int]) -> Estimate:
    """Return the estimate of one ordered pair in a window, without statuses."""
    solution, time_s = part.solution, part.time_s
    problem, values = solution.problem, solution.values
    state, spread = mix_members(solution, time_s, both)
    heights, height_std = height_errors(problem, values, solution.covariances[0], both)
    ends = float(time_s[0]), float(time_s[-1])
    return Estimate(
        time_s,
        state,
        spread,
        np.zeros(len(time_s), np.int8),
        _pair_constants(problem.layout, values.constants, both),
        problem.noise,
        height_m=interpolate_at(time_s, problem.keyframe_s, heights),
        height_std_m=interpolate_at(time_s, problem.keyframe_s, height_std),
        causes=tuple(
            replace(one, robot=None if one.robot is None else both.index(one.robot))
            for one in (*find_causes(solution.mixture, ends), *part.misfits)
            if one.robot is None or one.robot in both
        ),
        innovations=tuple(_select_innovations(part, both)),
    )


def _select_innovations(part: SwarmPart, both: tuple[int, int]) -> Iterator[Innovation]:
    """Yield the innovations of two robots and of their ranges."""
    links = iter(part.solution.problem.links)
    for one in part.innovations:
        if one.robot is None and set(next(links).robots) == set(both):
            yield one
        elif one.robot in both:
            yield replace(one, robot=both.index(one.robot))


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
