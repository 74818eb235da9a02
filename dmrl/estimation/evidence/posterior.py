"""Posterior over error models: each is solved from the plain solution and weighed by evidence.

The most likely model is combined with further ones, greedily. What is left are solutions under
several models and in several modes, with their probabilities: a mixture.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.evidence.error_models import Candidate, list_candidates
from dmrl.estimation.model.pair import Array
from dmrl.estimation.search.modes import COST_SCALE, SAME_TRACK_M, convert_values
from dmrl.estimation.solver.block_tridiagonal import reduce_to_constants, solve_step
from dmrl.estimation.solver.covariance import MIN_MOTION_ENERGY, odometry_energy
from dmrl.estimation.solver.equations import total_cost
from dmrl.estimation.solver.layout import Subject
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate, Solver, is_same_solution
from dmrl.estimation.solver.noise_selection import GRADE_BIAS, MIN_CONSTANTS_GRADE
from dmrl.estimation.solver.problem import Problem
from dmrl.estimation.solver.residuals import Values
from dmrl.estimation.solver.unknowns import YAW_RATE_ERROR

MAX_MODELS = 3
"""Largest number of error models that are combined."""
GRADE_SHARE, MIN_GRADE, MAX_GRADE = 0.75, 0.35, 3.0
"""Ratio of neighbouring grades of the noise, the smallest and the largest."""
MIN_STEP_GAIN = -6.0
"""Gain of a model by one Gauss-Newton step below which it is not solved, in log odds. Models that
change over time show their whole gain after some steps only: of 149 trials in 11 flights of the
judge, those that gained after all had -3.7 or more."""
RIVAL_ODDS = -7.0
"""Log odds of a model against the leading one from which it is tried with the later models, too:
the price of a rare model."""
MODEL_TOLERANCE = 3e-5
"""Relative change of the cost that ends the solve of a model."""
MIN_WEIGHT, MAX_MEMBERS = 0.02, 6
"""Least weight, and largest number, of the solutions of a mixture."""


@dataclass(frozen=True, slots=True)
class Member:
    """A solution under an error model.

    Parameters
    ----------
    solver
        Flight under the model.
    found
        The solution.
    score
        Log evidence with the prior log odds of its models.
    models
        Models that it has beyond the plain one.
    """

    solver: Solver
    found: MapEstimate
    score: float
    models: tuple[Candidate, ...] = ()

    @property
    def values(self) -> Values:
        """Values of the unknowns."""
        return self.found.values


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
    solver: Solver, modes: Sequence[MapEstimate], others: Sequence[Values] = ()
) -> Mixture:
    """Return the mixture of a flight's solutions under all error models.

    Parameters
    ----------
    solver
        Flight under the plain model.
    modes
        Its distinct solutions, best first.
    others
        Solutions with yaw rate biases that change, in the layout of the flight.
    """
    # The noise of the output is wider than the likeliest one, which compares models.
    solver = _with_grade(solver, max(solver.problem.noise.grade / GRADE_BIAS, MIN_GRADE))
    plain = _solve_under(solver, modes[0].values, ())
    if plain is None:
        return Mixture([Member(solver, modes[0], 0.0)], np.ones(1))
    members = [plain] + [
        Member(solver, mode, plain.score - (mode.cost - modes[0].cost) / COST_SCALE)
        for mode in modes[1:]
    ]
    best, rounds = plain, []
    candidates = _list_shown(solver.problem)
    for _ in range(MAX_MODELS):
        further = [one for one in candidates if one not in best.models]
        hopeless = _list_hopeless(best, further)
        tried = [
            one
            for candidate in further
            if candidate not in hopeless
            for one in _try_model(best, candidate, others)
        ]
        leader = max(tried, key=lambda one: one.score, default=best)
        members += tried
        if leader.score < best.score:
            break
        rounds.append((leader.models[-1], _list_rivals(leader, tried)))
        best = _select_grade(leader)
        members.append(best)
        others = ()
    members += _extend_rivals(rounds)
    return _mix([_widen(one) for one in _select_likely(members)])


def _list_shown(problem: Problem) -> list[Candidate]:
    """Return the error models that a flight can show.

    A robot that does not move shows no scale of its motion, but a scale would explain its noise.
    """
    moves = [odometry_energy(problem, k) >= MIN_MOTION_ENERGY for k in range(len(problem.robots))]
    return [
        one
        for one in list_candidates()
        if not any(row.motion_scale for row in one.model.rows)
        or (any(moves) if one.robot is None else moves[one.robot])
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
                rival = next(iter(_try_model(rival, candidate, ())), rival)
            yield _select_grade(rival)


def _prior(models: Sequence[Candidate]) -> float:
    """Return the prior log odds of some models."""
    return sum(one.model.log_odds for one in models)


def _with_grade(solver: Solver, grade: float) -> Solver:
    """Return a flight at another grade of its noise."""
    noise = replace(
        solver.problem.noise, grade=grade, constants_grade=max(grade, MIN_CONSTANTS_GRADE)
    )
    return replace(solver, problem=replace(solver.problem, noise=noise))


def _solve_under(
    solver: Solver, start: Values, models: tuple[Candidate, ...], tolerance: float = MODEL_TOLERANCE
) -> Member | None:
    """Return the solution of a flight under its models; None if it has none."""
    try:
        found = solver.solve(start, tolerance=tolerance)
        score = solver.log_evidence(found) + _prior(models)
    except np.linalg.LinAlgError:
        return None
    return Member(solver, found, score, models)


def _try_model(base: Member, candidate: Candidate, others: Sequence[Values]) -> list[Member]:
    """Return the solutions with one more model.

    Parameters
    ----------
    base
        Solution without it.
    candidate
        The model.
    others
        Solutions with yaw rate biases that change, as further starts of that model.
    """
    solver = replace(base.solver, problem=candidate.apply(base.solver.problem))
    before, models = base.solver.layout, (*base.models, candidate)
    starts = [base.values, *(others if YAW_RATE_ERROR in candidate.model.rows else ())]
    values = [convert_values(start, before, solver.layout) for start in starts]
    rough = np.inf if candidate.model.adds_constants else _step_score(solver, values[0], models)
    if rough < base.score + MIN_STEP_GAIN:
        values = values[1:]
    found = [_solve_under(solver, start, models) for start in values]
    return [one for one in found if one is not None]


def _list_hopeless(base: Member, candidates: Sequence[Candidate]) -> set[Candidate]:
    """Return the models of constants that gain too little by one Gauss-Newton step.

    One linearization has the constants of all models, and each model takes its columns of the
    Schur complement.
    """
    constant = [one for one in candidates if one.model.adds_constants]
    problem, own = base.solver.problem, base.solver.layout
    added = {}
    for one in constant:
        added[one] = one.apply(base.solver.problem).layout.subjects().keys() - own.subjects().keys()
        problem = one.apply(problem)
    solver = replace(base.solver, problem=problem)
    values = convert_values(base.values, own, solver.layout)
    try:
        information, vector = reduce_to_constants(solver.equations(values)[0])
    except np.linalg.LinAlgError:
        return set()
    log_std = np.log(solver.problem.noise.prior_std(solver.layout))
    subjects = [subject for subject, _ in solver.layout.constants]
    known = {subject for subject, _ in own.constants}

    def evidence(names: Collection[Subject]) -> float:
        at = [k for k, subject in enumerate(subjects) if subject in known or subject in names]
        block, slope = information[np.ix_(at, at)], vector[at]
        gain = slope @ np.linalg.solve(block, slope)
        return float(gain - np.linalg.slogdet(block)[1]) / 2 - float(log_std[at].sum())

    plain = evidence(())
    return {
        one
        for one, names in added.items()
        if evidence(names) - plain + one.model.log_odds < MIN_STEP_GAIN
    }


def _step_score(solver: Solver, start: Values, models: tuple[Candidate, ...]) -> float:
    """Return the score that one Gauss-Newton step leads to."""
    try:
        equations, factors = solver.equations(start)
        solved = solve_step(equations)
    except np.linalg.LinAlgError:
        return -np.inf
    slope = float((equations.gradient * solved.state).sum())
    slope += float(equations.globals_gradient @ solved.constants)
    begun = MapEstimate(start, total_cost(factors))
    score = solver.laplace_evidence(begun, factors, solved.log_det) + _prior(models)
    return score - slope / 2


def _select_grade(member: Member) -> Member:
    """Return the solution at the likeliest of the grades around."""
    best = member
    for way in (GRADE_SHARE, 1 / GRADE_SHARE):
        while MIN_GRADE <= (grade := best.solver.problem.noise.grade * way) <= MAX_GRADE:
            one = _solve_under(_with_grade(best.solver, grade), best.values, member.models)
            if one is None or one.score < best.score:
                break
            best = one
    return best


def _widen(member: Member) -> Member:
    """Return a solution with the noise that counts for its covariance."""
    solver = _with_grade(member.solver, member.solver.problem.noise.grade * GRADE_BIAS)
    try:
        return replace(member, solver=solver, found=solver.solve(member.values))
    except np.linalg.LinAlgError:
        return member


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
