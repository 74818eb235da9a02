from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight.pair_solver import solve_pair
from dmrl.estimation.model.pair import Array, BearingMeasurements
from dmrl.estimation.solver.camera_noise import MIN_IMAGES, calibrate_views, count_repeated
from dmrl.estimation.solver.keyframes import build_problem
from dmrl.estimation.solver.levenberg_marquardt import MapEstimate, Solver
from dmrl.estimation.solver.residuals import bearing_factor

from ..flights import flown, pair_of
from ..sighted_flights import NOISE, STD, sightings


def solve_sighted(sees: BearingMeasurements) -> tuple[Solver, MapEstimate]:
    """The plain solution of a flight of 60 s with the detections of the first robot."""
    pair = replace(pair_of(flown("in_view", "calibrated", 1000, 60.0)), own_bearings=sees)
    member = solve_pair(build_problem({(0, 1): pair}), plain=True).mixture.members[0]
    views = build_problem({(0, 1): pair}).views
    return replace(member.solver, problem=replace(member.solver.problem, views=views)), member.found


def see(hz: float = 10.0) -> BearingMeasurements:
    return sightings(flown("in_view", "calibrated", 1000, 60.0), "cf1", ("cf2",), hz=hz)


@pytest.mark.heavy
@pytest.mark.parametrize("assumed", [1.0, 2.5])
def test_noise_of_detections_is_that_of_their_residuals(assumed: float) -> None:
    sees = see()
    solver, found = solve_sighted(replace(sees, std=sees.std * assumed))
    (view,) = calibrate_views(solver, found)[0].problem.views
    ratio = view.std[0, 0] / NOISE
    assert ratio == pytest.approx(np.ones(3), abs=0.35)
    assert (view.weight == 1).all()


@pytest.mark.heavy
def test_errors_that_last_count_once() -> None:
    sees, rng = see(), np.random.default_rng(4)
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
    assert view.std[0, 0, 2] > 2.0 * STD[2] * 0.9


def test_few_images_keep_their_noise() -> None:
    sees = see(hz=0.5)
    assert len(sees.time_s) < MIN_IMAGES
    solver, found = solve_sighted(sees)
    assert calibrate_views(solver, found) == (solver, found)


def test_independent_residuals_are_not_repeated() -> None:
    solver, found = solve_sighted(see())
    (view,) = solver.problem.views
    rows = bearing_factor(solver.problem, solver.layout, view, found.values)
    rng = np.random.default_rng(1)
    residual: Array = rows.rows.copy()
    residual[..., -1] = 0.5 * rng.standard_normal(residual.shape[:-1])
    assert count_repeated(replace(rows, rows=residual), view) == pytest.approx(np.ones(3), abs=0.4)
