"""Posterior over error models: each is solved from the plain solution and weighed by evidence.

The most likely model is combined with further ones, greedily. What is left are solutions under
several models and in several modes, with their probabilities: a mixture.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.evidence.error_models import Candidate, list_candidates
from dmrl.estimation.evidence.model_trials import (
    MIN_GRADE,
    Member,
    Others,
    select_grade,
    solve_under,
    try_model,
    try_models,
    with_grade,
)
from dmrl.estimation.model.pair import Array
from dmrl.estimation.search.modes import COST_SCALE, SAME_TRACK_M
from dmrl.estimation.signals.jump_detection import find_spacing
from dmrl.estimation.solver.covariance import MIN_MOTION_ENERGY, odometry_energy
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate, Solver, is_same_solution
from dmrl.estimation.solver.noise_selection import GRADE_BIAS
from dmrl.estimation.solver.problem import Problem

MAX_MODELS = 3
"""Largest number of error models that are combined."""
RIVAL_ODDS = -7.0
"""Log odds of a model against the leading one from which it is tried with the later models, too:
the price of a rare model."""
MIN_WEIGHT, MAX_MEMBERS = 0.02, 6
"""Least weight, and largest number, of the solutions of a mixture."""


@dataclass(frozen=True, slots=True)
class Mixture:
    """Solutions with weights, best first.

    Parameters
    ----------
    members
        The solutions.
    weight
        (M,) probabilities, with sum 1.
    """

    members: list[Member]
    weight: Array

    def probabilities(self) -> dict[Candidate, float]:
        """Return the probability of each error model."""
        out: dict[Candidate, float] = {}
        for member, weight in zip(self.members, self.weight.tolist(), strict=True):
            for model in member.models:
                out[model] = out.get(model, 0.0) + weight
        return out


def weigh_models(
    solver: Solver,
    modes: Sequence[MapEstimate],
    others: Others = tuple,
    candidates: Sequence[Candidate] | None = None,
) -> Mixture:
    """Return the mixture of a flight's solutions under error models.

    Parameters
    ----------
    solver
        Flight under the plain model.
    modes
        Its distinct solutions, best first.
    others
        Returns solutions with yaw rate biases that change, in the layout of the flight.
    candidates
        The error models. None: all that the flight can show.
    """
    # The noise of the output is wider than the likeliest one, which compares models.
    solver = with_grade(solver, max(solver.problem.noise.grade / GRADE_BIAS, MIN_GRADE))
    plain = solve_under(solver, modes[0].values, ())
    if plain is None:
        return Mixture([Member(solver, modes[0], 0.0)], np.ones(1))
    members = [plain] + [
        Member(solver, mode, plain.score - (mode.cost - modes[0].cost) / COST_SCALE)
        for mode in modes[1:]
    ]
    best, rounds = plain, []
    candidates = list_shown(solver.problem) if candidates is None else candidates
    for _ in range(MAX_MODELS):
        tried = try_models(best, candidates, others)
        members += tried
        if not tried or (leader := max(tried, key=lambda one: one.score)).score < best.score:
            break
        rounds.append((leader.models[-1], _list_rivals(leader, tried)))
        best = select_grade(leader)
        members.append(best)
        others = tuple
    members += _extend_rivals(rounds)
    return _mix([_widen(one) for one in _select_likely(members)])


def list_shown(problem: Problem) -> list[Candidate]:
    """Return the error models that a flight can show.

    A robot that does not move shows no scale of its motion, but a scale would explain its noise.
    Ranges that are rounded coarsely jump by what they are rounded to. Where both robots range, the
    offset of their clocks is known already.
    """
    ranged = any(name == "clock" for name, _ in problem.noise.known_std)
    coarse = any(find_spacing(link.range_m) > problem.noise.range_std_m for link in problem.links)
    moves = [odometry_energy(problem, k) >= MIN_MOTION_ENERGY for k in range(len(problem.robots))]
    return [
        one
        for one in list_candidates(len(problem.robots))
        if not (coarse and one.model.sudden)
        and not (ranged and any(row.name == "clock_free" for row in one.model.rows))
        and (not one.model.scales_motion or (any(moves) if one.robot is None else moves[one.robot]))
    ]


def _list_rivals(leader: Member, tried: Sequence[Member]) -> list[Member]:
    """Return the solutions under other models that are nearly as likely as the leading one."""
    least = leader.score + RIVAL_ODDS
    return [one for one in tried if one.models != leader.models and one.score > least]


def _extend_rivals(rounds: Sequence[tuple[Candidate, Sequence[Member]]]) -> Iterator[Member]:
    """Yield rivals of each round with the models of the later rounds.

    Without them, a rival that explains as much as the leader, such as the scale of the flow for the
    scale of the ranges, would lose its weight to the first model that both lack.
    """
    for number, (_, rivals) in enumerate(rounds[:-1], 1):
        for rival in rivals:
            for candidate, _ in rounds[number:]:
                rival = next(iter(try_model(rival, candidate)), rival)
            yield select_grade(rival)


def _widen(member: Member) -> Member:
    """Return a solution with the noise that counts for its covariance."""
    solver = with_grade(member.solver, member.solver.problem.noise.grade * GRADE_BIAS)
    return replace(member, solver=solver, found=solver.solve(member.values))


def _select_likely(members: Sequence[Member]) -> list[Member]:
    """Return the distinct solutions that matter, best first."""
    out: list[Member] = []
    for one in sorted(members, key=lambda one: -one.score):
        if one.score < members[0].score and one.score < out[0].score + np.log(MIN_WEIGHT):
            break
        if not any(
            one.models == other.models and is_same_solution(one.values, other.values, SAME_TRACK_M)
            for other in out
        ):
            out.append(one)
    return out[:MAX_MEMBERS]


def _mix(members: Sequence[Member]) -> Mixture:
    """Return members with their weights."""
    weight = np.exp(np.array([one.score for one in members]) - members[0].score)
    return Mixture(list(members), weight / weight.sum())
