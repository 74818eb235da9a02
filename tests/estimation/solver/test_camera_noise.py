"""The noise of detections, estimated from the residuals of a solve."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dmrl.estimation.flight.pair_solver import solve_pair
from dmrl.estimation.model.pair import Array, BearingMeasurements
from dmrl.estimation.solver import camera_noise
from dmrl.estimation.solver.camera_noise import (
    MIN_CONSTANT_RATIO,
    MIN_IMAGES,
    calibrate_views,
    count_repeated,
    estimate_constant_error,
)
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate, Solver
from dmrl.estimation.solver.residuals import bearing_factor

from ..flights import build_pair, simulate_flight
from ..sighted_flights import NOISE, simulate_bearings

pytestmark = pytest.mark.heavy


def solve_sighted(sees: BearingMeasurements) -> tuple[Solver, MapEstimate]:
    """Solve a flight of 60 s with detections of the first robot, without error models."""
    pair = replace(
        build_pair(simulate_flight("in_view", "calibrated", 1000, 60.0)), own_bearings=sees
    )
    member = solve_pair(build_problem({(0, 1): pair}), plain=True).mixture.members[0]
    views = build_problem({(0, 1): pair}).views
    return replace(member.solver, problem=replace(member.solver.problem, views=views)), member.found


def simulate_images(hz: float = 10.0) -> BearingMeasurements:
    """Return detections of cf2 in the images of cf1."""
    return simulate_bearings(
        simulate_flight("in_view", "calibrated", 1000, 60.0), "cf1", ("cf2",), hz=hz
    )


@cache
def solve_seen() -> tuple[Solver, MapEstimate]:
    """Solve the simulated pair with its detections."""
    return solve_sighted(simulate_images())


@pytest.mark.parametrize("assumed", [1.0, 2.5])
def test_noise_of_detections_is_that_of_their_residuals(assumed: float) -> None:
    sees = simulate_images()
    solver, found = solve_sighted(replace(sees, std=sees.std * assumed))
    (view,) = calibrate_views(solver, found)[0].problem.views
    ratio = view.std[0, 0] / NOISE
    assert ratio == pytest.approx(np.ones(3), abs=0.35)
    assert (view.weight == 1).all()


def test_correlated_errors_count_once() -> None:
    sees, rng = simulate_images(), np.random.default_rng(4)
    lasting = np.zeros(len(sees.time_s))
    for k in range(1, len(lasting)):
        lasting[k] = 0.95 * lasting[k - 1] + 0.06 * rng.standard_normal()
    polar = sees.bearing.copy()
    polar[..., 2] += lasting[:, None]
    solver, found = solve_sighted(replace(sees, bearing=polar))
    trusted, best = calibrate_views(solver, found)
    (view,) = trusted.problem.views
    rows = bearing_factor(trusted.problem, trusted.layout, view, best.values)
    repeated = count_repeated(rows, view)
    assert repeated[2] > 4 and (repeated[:2] < 2.5).all()
    shown = float(np.hypot(NOISE[2], lasting.std()))
    assert view.std[0, 0, 2] > 1.5 * shown
    assert view.std[0, 0, :2] == pytest.approx(NOISE[:2], rel=0.6)
    # Distances may be wrong throughout by as much as they are for seconds.
    assert known_distance_std(trusted) == pytest.approx(lasting.std(), rel=0.5)


def known_distance_std(solver: Solver) -> float:
    """Return the prior standard deviation of the constant error of the first robot's distances."""
    return solver.problem.noise.known_std["camera_distance", (0,)]


def test_distances_with_independent_errors_are_right_in_the_mean() -> None:
    trusted, best = calibrate_views(*solve_seen())
    assert known_distance_std(trusted) == pytest.approx(MIN_CONSTANT_RATIO, abs=0.02)
    column = [name for (name, _), _ in trusted.layout.constants].index("camera_distance")
    assert abs(best.values.constants[column]) < MIN_CONSTANT_RATIO


def test_constant_error_is_as_large_as_the_lasting_part() -> None:
    assert estimate_constant_error(0.1, 1.0) == MIN_CONSTANT_RATIO
    assert estimate_constant_error(0.1, 50.0) == pytest.approx(0.1034, abs=1e-3)


def test_few_images_keep_their_noise() -> None:
    sees = simulate_images(hz=0.5)
    assert len(sees.time_s) < MIN_IMAGES
    solver, found = solve_sighted(sees)
    assert calibrate_views(solver, found) == (solver, found)


def test_independent_residuals_are_not_repeated() -> None:
    solver, found = solve_seen()
    (view,) = solver.problem.views
    rows = bearing_factor(solver.problem, solver.layout, view, found.values)
    rng = np.random.default_rng(1)
    residual: Array = rows.rows.copy()
    residual[..., -1] = 0.5 * rng.standard_normal(residual.shape[:-1])
    assert count_repeated(replace(rows, rows=residual), view) == pytest.approx(np.ones(3), abs=0.4)


def test_leverage_is_that_of_the_whole_matrix() -> None:
    pair = replace(
        build_pair(simulate_flight("in_view", "calibrated", 1000, 20.0)),
        own_bearings=simulate_images(),
    )
    solver = Solver(build_problem({(0, 1): pair}))
    values = solve_pair(solver.problem, plain=True).values
    equations = solver.equations(values)[0]
    count, width = equations.gradient.shape
    whole = np.zeros((count * width + len(equations.globals_block),) * 2)
    for k in range(count):
        at = slice(k * width, (k + 1) * width)
        whole[at, at] = equations.diagonal[k]
        whole[at, count * width :] = equations.coupling[k]
        if k < count - 1:
            after = slice((k + 1) * width, (k + 2) * width)
            whole[at, after] = equations.off_diagonal[k]
            whole[after, at] = equations.off_diagonal[k].T
    whole[count * width :, : count * width] = whole[: count * width, count * width :].T
    whole[count * width :, count * width :] = equations.globals_block
    covariance = np.linalg.inv(whole)
    (view,) = solver.problem.views
    rows = bearing_factor(solver.problem, solver.layout, view, values)
    found = camera_noise._Posterior.at(solver, values).leverage(rows)
    size = len(rows.columns)
    for k in range(0, count, 7):
        jacobian = np.zeros((3, len(whole)))
        jacobian[:, k * width + np.array(rows.columns)] = rows.rows[k, 0, :, :size]
        jacobian[:, count * width + np.array(rows.border)] = rows.rows[k, 0, :, size:-1]
        expected = np.diag(jacobian @ covariance @ jacobian.T)
        assert found[k, 0] == pytest.approx(expected, rel=1e-4, abs=1e-9)


def test_noise_is_larger_than_residuals_by_their_leverage(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    solver, found = solve_seen()
    (view,) = solver.problem.views
    rows = bearing_factor(solver.problem, solver.layout, view, found.values)
    posterior = camera_noise._Posterior.at(solver, found.values)
    ratios = []
    for share in (0.0, 0.75):
        half = np.full(rows.rows.shape[:-1], share)
        monkeypatch.setattr(camera_noise._Posterior, "leverage", lambda *_, half=half: half)
        ratios.append(camera_noise._noise_ratio(rows, posterior))
    assert ratios[1] == pytest.approx(2 * ratios[0])


def test_exact_and_repeated_images_have_a_noise() -> None:
    solver, found = solve_seen()
    (view,) = solver.problem.views
    rows = bearing_factor(solver.problem, solver.layout, view, found.values)
    exact = rows.rows.copy()
    exact[..., -1] = 0.0
    assert count_repeated(replace(rows, rows=exact), view) == pytest.approx(np.ones(3))
    twice = replace(view, time_s=np.repeat(view.time_s[::2], 2)[: len(view.time_s)])
    assert np.isfinite(count_repeated(rows, twice)).all()


def test_a_camera_that_no_longer_fits_keeps_its_noise() -> None:
    solver, found = solve_seen()
    (view,) = solver.problem.views
    rows = bearing_factor(solver.problem, solver.layout, view, found.values)
    far = rows.rows.copy()
    far[..., -1] = 100.0
    posterior = camera_noise._Posterior.at(solver, found.values)
    assert (camera_noise._noise_ratio(replace(rows, rows=far), posterior) == 1).all()
