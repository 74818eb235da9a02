"""Levenberg-Marquardt solves, and the Laplace evidence of a model."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.search.modes import coarsen, place_peer
from dmrl.estimation.solver import levenberg_marquardt
from dmrl.estimation.solver.block_tridiagonal import NormalEquations, solve_step
from dmrl.estimation.solver.keyframes import average_ranges, build_problem
from dmrl.estimation.solver.layout import Layout
from dmrl.estimation.solver.levenberg_marquardt import (
    MAX_ITERATIONS,
    MIN_DAMPING,
    SMALL_DAMPING,
    MapEstimate,
    Solver,
    apply_step,
    is_same_solution,
    relative_path,
)
from dmrl.estimation.solver.problem import NoiseModel
from dmrl.estimation.solver.residuals import Factor, Values
from dmrl.estimation.solver.unknowns import TABLE, without_rows

from ..flights import build_pair, simulate_flight
from .test_residuals import build_flight, perturb


def test_solve_converges_to_the_true_flight() -> None:
    problem, true = build_flight()
    start = perturb(true, 3)
    found = Solver(problem).solve(start)
    error = relative_path(found.values.state) - relative_path(true.state)
    assert np.abs(error[:, :2]).max() < 0.01 < np.abs(start.state - true.state).max()
    again = Solver(problem).solve(found.values)
    assert again.cost == pytest.approx(found.cost, rel=1e-3)


def test_a_step_that_turns_all_robots_keeps_what_they_measure() -> None:
    _, true = build_flight()
    turn = np.linspace(0.0, 1.5, len(true.state))
    place = true.state[:, 0:6:3] + 1j * true.state[:, 1:6:3]
    path = np.cumsum(1j * turn[:-1] * np.diff(place[:, 0]))
    path = np.concatenate([[0.0], path])[:, None]
    moves = np.hstack([path, path + 1j * turn[:, None] * np.diff(place)])
    step = np.zeros_like(true.state)
    step[:, 0:6:3], step[:, 1:6:3], step[:, [2, 5]] = moves.real, moves.imag, turn[:, None]
    turned = apply_step(true, step, np.zeros_like(true.constants), 2)
    np.testing.assert_allclose(relative_path(turned.state), relative_path(true.state), atol=1e-9)
    way = np.abs(np.diff(turned.state[:, 0:6:3] + 1j * turned.state[:, 1:6:3], axis=0))
    assert way[:, 0] == pytest.approx(np.abs(np.diff(place[:, 0])))
    # A small step is simply added.
    near = apply_step(true, 1e-5 * step, np.ones_like(true.constants), 2)
    np.testing.assert_allclose(near.state, true.state + 1e-5 * step, atol=1e-8)
    assert (near.constants == true.constants + 1).all()


@pytest.mark.heavy
def test_a_small_gain_of_a_damped_step_does_not_end_the_iteration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The start has a wrong heading of the peer, so the first steps fail and damping rises."""
    flown_pair = build_pair(simulate_flight("random", "realistic", 1004, 20.0))
    problem = coarsen(build_problem({(0, 1): flown_pair}))
    pose = np.tile([1.5, 0.0, 0.0], (len(problem.keyframe_s), 1))
    start, used = place_peer(problem, pose, np.zeros(2)), []
    damped = NormalEquations.damped

    def record(equations: NormalEquations, damping: float) -> NormalEquations:
        used.append(damping)
        return damped(equations, damping)

    monkeypatch.setattr(NormalEquations, "damped", record)
    Solver(problem).solve(start, tolerance=0.01)
    assert max(used) >= MIN_DAMPING
    assert used[-1] <= SMALL_DAMPING or len(used) == MAX_ITERATIONS


def test_a_singular_step_is_damped_until_it_can_be_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, true = build_flight()
    build, singular = levenberg_marquardt.build_equations, []

    def build_indefinite_first(
        layout: Layout, factors: list[Factor], count: int
    ) -> NormalEquations:
        equations = build(layout, factors, count)
        if not singular:
            equations = replace(equations, diagonal=0.9 * equations.diagonal)
            singular.append(equations)
        return equations

    monkeypatch.setattr(levenberg_marquardt, "build_equations", build_indefinite_first)
    found = Solver(problem).solve(perturb(true, 3))
    error = relative_path(found.values.state) - relative_path(true.state)
    assert np.abs(error[:, :2]).max() < 0.01
    with pytest.raises(np.linalg.LinAlgError):
        solve_step(singular[0])


@pytest.mark.heavy
def test_an_iteration_ends_at_a_known_solution() -> None:
    problem, true = build_flight()
    whole = Solver(problem).solve(perturb(true, 3), tolerance=0.0)
    early = Solver(problem).solve(perturb(true, 3), [whole], tolerance=0.0, same_m=0.02)
    assert early.cost >= whole.cost
    assert is_same_solution(early.values, whole.values, 0.02)


def test_solutions_are_equal_if_their_relative_paths_are() -> None:
    _, true = build_flight()
    state = true.state.copy()
    state[7, 3] += 0.06
    other = Values(state, true.constants)
    assert not is_same_solution(true, other)
    assert is_same_solution(true, other, 0.07)
    turned = true.state.copy()
    turned[:, 0] += 5.0
    turned[:, 3] += 5.0
    assert is_same_solution(true, Values(turned, true.constants))


def test_a_relative_path_is_the_peer_in_the_observer_s_frame() -> None:
    state = np.array([[1.0, 2.0, np.pi / 2, 1.0, 4.0, 0.3]])
    assert relative_path(state)[0] == pytest.approx([2.0, 0.0, 0.3 - np.pi / 2])
    assert relative_path(state, 1, 0)[0, :2] == pytest.approx([-2 * np.sin(0.3), -2 * np.cos(0.3)])


@pytest.mark.heavy
def test_log_evidence_equals_laplace_approximation_by_quadrature() -> None:
    """The range offset is integrated numerically and compared with its Laplace approximation."""
    problem, true = build_flight()
    rows = without_rows(TABLE, ("velocity_error_x", "velocity_error_y", "range_error"))
    small = replace(problem, table=rows, views=())
    start = Values(true.state[:, :6], np.zeros(len(small.layout.constants)))
    free = Solver(small).solve(start, tolerance=1e-9)
    at = small.layout.find("range_offset", 0, 1)
    grid = np.linspace(-0.4, 0.4, 33)
    logs = []
    for value in grid:
        # The offset is subtracted from the ranges, and its prior density is added by hand.
        (link,) = small.links
        shifted = replace(link, range_m=link.range_m - value)
        rest = without_rows(rows, ("range_offset",))
        held = Solver(replace(small, table=rest, links=(shifted,)))
        constants = np.delete(free.values.constants, at)
        found = held.solve(Values(free.values.state, constants), tolerance=1e-9)
        row = next(row for row in rows if row.name == "range_offset")
        prior = float(row.loss.cost(np.array((value / row.std) ** 2))) / 2
        logs.append(held.log_evidence(found) - prior - np.log(row.std))
    total = np.log(np.sum(np.exp(np.array(logs) - max(logs))) * (grid[1] - grid[0])) + max(logs)
    # `log_evidence` leaves out the constant factor sqrt(2 pi) per unknown.
    laplace = Solver(small).log_evidence(free) + np.log(2 * np.pi) / 2
    assert laplace == pytest.approx(total, abs=0.3)


@pytest.mark.heavy
def test_evidence_prefers_the_true_noise() -> None:
    pair = build_pair(simulate_flight("random", "calibrated", 1001, 40.0))
    problem = build_problem({(0, 1): pair})
    links = tuple(average_ranges(link, problem.keyframe_s) for link in problem.links)
    start = None
    found: dict[float, float] = {}
    for grade in (0.5, 3.0):
        solver = Solver(replace(problem, links=links, noise=NoiseModel(grade=grade)))
        if start is None:
            flown_state = _true_values(pair, solver)
            start = flown_state
        solution = solver.solve(start)
        found[grade] = solver.log_evidence(solution)
        assert isinstance(solution, MapEstimate)
    assert found[0.5] > found[3.0] + 10


def _true_values(pair: object, solver: Solver) -> Values:
    """Return the true values of the flight of `test_evidence_prefers_the_true_noise`."""
    world, layout = simulate_flight("random", "calibrated", 1001, 40.0), solver.layout
    key_s = solver.problem.keyframe_s
    state = np.zeros((len(key_s), layout.width))
    for robot, name in enumerate(("cf1", "cf2")):
        truth, mine = world.truth[name], layout.pose(robot)
        state[:, mine[:2]] = truth.position_at(key_s)[:, :2]
        state[:, mine[2]] = truth.yaw_at(key_s)
    # The origin of the frame is the first position of the first robot.
    state[:, [0, 3]] -= state[0, 0]
    state[:, [1, 4]] -= state[0, 1]
    assert state[0, 2] == pytest.approx(0.0, abs=0.2)
    return Values(state, np.zeros(len(layout.constants)))
