"""Block tridiagonal normal equations, compared with dense ones."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.block_tridiagonal import (
    NormalEquations,
    eliminate_before,
    marginal_covariances,
    solve_step,
)

KEYS, WIDTH, GLOBALS = 5, 3, 2


def draw_equations(seed: int = 0) -> tuple[NormalEquations, Array, Array]:
    """Return equations of random rows, and their dense matrix and vector."""
    rng = np.random.default_rng(seed)
    out = NormalEquations.zeros(KEYS, WIDTH, GLOBALS)
    size = KEYS * WIDTH + GLOBALS
    dense, vector = np.zeros((size, size)), np.zeros(size)
    for columns, border, steps in (
        ([0, 2], [1], True),
        ([0, 1, 2], [0, 1], False),
        ([1], [], True),
    ):
        count = KEYS - steps
        width = len(columns) * (1 + steps) + len(border) + 1
        rows = rng.normal(size=(count, 4, width))
        out.add_rows(rows, columns, border, bool(steps))
        for key in range(count):
            at = [key * WIDTH + c for c in columns]
            at += [(key + 1) * WIDTH + c for c in columns] if steps else []
            at += [KEYS * WIDTH + b for b in border]
            jacobian, residual = rows[key, :, :-1], rows[key, :, -1]
            dense[np.ix_(at, at)] += jacobian.T @ jacobian
            vector[at] += jacobian.T @ residual
    out.mirror()
    return out, dense, vector


def test_normal_equations_equal_dense_jtj() -> None:
    found, dense, vector = draw_equations()
    for key in range(KEYS):
        mine = slice(key * WIDTH, (key + 1) * WIDTH)
        assert found.diagonal[key] == pytest.approx(dense[mine, mine])
        assert found.coupling[key] == pytest.approx(dense[mine, KEYS * WIDTH :])
        assert found.gradient[key] == pytest.approx(vector[mine])
        if key:
            assert found.off_diagonal[key - 1] == pytest.approx(
                dense[mine.start - WIDTH : mine.start, mine]
            )
    assert found.globals_block == pytest.approx(dense[-GLOBALS:, -GLOBALS:])
    assert found.globals_gradient == pytest.approx(vector[-GLOBALS:])


def test_step_equals_dense_solve() -> None:
    found, dense, vector = draw_equations()
    step = solve_step(found)
    wanted = -np.linalg.solve(dense, vector)
    assert np.append(step.state.ravel(), step.constants) == pytest.approx(wanted)
    inverse = np.linalg.inv(dense)
    assert step.covariance == pytest.approx(inverse[-GLOBALS:, -GLOBALS:])
    assert step.log_det == pytest.approx(np.linalg.slogdet(dense)[1])
    spread = marginal_covariances(found.diagonal, found.off_diagonal)
    spread = spread + step.response() @ step.covariance @ step.response().swapaxes(1, 2)
    for key in range(KEYS):
        mine = slice(key * WIDTH, (key + 1) * WIDTH)
        assert spread[key] == pytest.approx(inverse[mine, mine])


def test_damping_applies_to_keyframes_only() -> None:
    found, *_ = draw_equations()
    damped = found.damped(3.0)
    assert damped.diagonal[2].diagonal() == pytest.approx(4 * found.diagonal[2].diagonal())
    assert damped.diagonal[2, 0, 1] == found.diagonal[2, 0, 1]
    assert (damped.globals_block == found.globals_block).all()
    assert found.damped(0.0) is found


def test_a_matrix_that_is_not_positive_definite_is_an_error() -> None:
    found, *_ = draw_equations()
    with pytest.raises(np.linalg.LinAlgError):
        solve_step(replace(found, diagonal=-found.diagonal))


def test_eliminated_keyframes_leave_the_schur_complement() -> None:
    found, dense, vector = draw_equations()
    information, pull = eliminate_before(found, 3)
    gone = np.arange(3 * WIDTH)
    kept = np.concatenate([np.arange(3 * WIDTH, 4 * WIDTH), np.arange(GLOBALS) + KEYS * WIDTH])
    solved = np.linalg.solve(dense[np.ix_(gone, gone)], dense[np.ix_(gone, kept)])
    assert information == pytest.approx(
        dense[np.ix_(kept, kept)] - dense[np.ix_(kept, gone)] @ solved
    )
    assert pull == pytest.approx(vector[kept] - solved.T @ vector[gone])
