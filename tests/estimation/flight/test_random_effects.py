"""Sensor constants pooled over flights, with their spread between flights."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight.random_effects import (
    FlightInformation,
    flight_information,
    pool_flights,
)
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.estimate import PAIR_LAYOUT, Estimate
from dmrl.estimation.solver.priors import ConstantPrior
from dmrl.estimation.solver.problem import NoiseModel

SUBJECTS = [subject for subject, _ in PAIR_LAYOUT.constants]
ROWS = [row for _, row in PAIR_LAYOUT.constants]
SIZE = len(ROWS)
ALL = np.arange(SIZE)
USUAL = NoiseModel().prior_std(PAIR_LAYOUT)
OWN_GYRO, PEER_GYRO = (PAIR_LAYOUT.find("gyro_bias", side) for side in (0, 1))
RANGE_BIAS = PAIR_LAYOUT.find("range_offset", 0, 1)


def build_prior(found: Array) -> ConstantPrior:
    """Return the prior of sensor constants at given values."""
    return ConstantPrior(found, USUAL, tuple(row.loss for row in ROWS))


def draw_information(rng: np.random.Generator, rank: int = SIZE) -> Array:
    """Draw the information of a flight about its constants, with a given rank and wide range."""
    rows = rng.normal(size=(rank, SIZE)) * rng.uniform(0.3, 10, (rank, 1)) / USUAL
    return np.asarray(rows.T @ rows)


def solve(seen: Array, likeliest: Array) -> Estimate:
    """Return the estimate of a flight, whose prior pulls the constants towards zero."""
    noise, found = NoiseModel(), np.zeros(SIZE)
    for _ in range(200):
        found = np.linalg.solve(seen + np.diag(build_prior(found).information()), seen @ likeliest)
    covariance = np.linalg.inv(seen + np.diag(build_prior(found).curvature()))
    state, spread, status = np.zeros((2, 3)), np.stack([np.eye(3)] * 2), np.zeros(2, np.int8)
    made = Estimate(np.arange(2.0), state, spread, status, found, noise)
    return replace(made, constants_covariance=covariance)


def test_flight_information_excludes_the_prior() -> None:
    rng = np.random.default_rng(0)
    seen, likeliest = draw_information(rng), rng.normal(0, 0.5 * USUAL)
    out = flight_information(solve(seen, likeliest), SUBJECTS, ALL)
    scale = np.outer(USUAL, USUAL)
    assert out.information * scale == pytest.approx(seen * scale, rel=1e-6, abs=1e-6)
    assert out.information_vector * USUAL == pytest.approx(seen @ likeliest * USUAL, rel=1e-4)


@pytest.mark.heavy
def test_pooled_std_predicts_error_of_the_next_flight() -> None:
    """The constants of many robots vary by 0.3 of their prior std between flights."""
    rng = np.random.default_rng(1)
    off = []
    for _ in range(60):
        own = rng.normal(0, USUAL)
        flights = [own + rng.normal(0, 0.3 * USUAL) for _ in range(6)]
        seen = [draw_information(rng) for _ in flights]
        parts = [
            FlightInformation(one, one @ flight, ALL)
            for one, flight in zip(seen, flights, strict=True)
        ]
        found = pool_flights(parts, ROWS)
        assert (found.flights == 5).sum() == 0
        off.append((own + rng.normal(0, 0.3 * USUAL) - found.mean) / found.std)
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.25


def test_pooling_assigns_a_common_difference_to_the_shared_robot() -> None:
    row = np.zeros(SIZE)
    row[OWN_GYRO], row[PEER_GYRO] = -1e4, 1e4
    seen = np.outer(row, row)
    true = np.zeros(SIZE)
    true[PEER_GYRO] = 0.05
    # The second flight has another first robot, so the error belongs to the shared one.
    columns = [ALL, np.where(ALL == OWN_GYRO, SIZE, ALL)]
    rows = [*ROWS, ROWS[OWN_GYRO]]
    found = pool_flights([FlightInformation(seen, seen @ true, column) for column in columns], rows)
    assert found.mean[PEER_GYRO] == pytest.approx(0.05, abs=0.003)
    assert found.mean[[OWN_GYRO, SIZE]] == pytest.approx(0.0, abs=0.003)


@pytest.mark.heavy
def test_constant_that_varies_between_flights_keeps_a_wide_std() -> None:
    seen = np.zeros((SIZE, SIZE))
    seen[RANGE_BIAS, RANGE_BIAS] = 1e6
    offsets = [-0.4, 0.5, 0.1, -0.3, 0.45, -0.35]
    found = pool_flights(
        [FlightInformation(seen, seen[RANGE_BIAS] * offset, ALL) for offset in offsets], ROWS
    )
    assert found.std[RANGE_BIAS] > USUAL[RANGE_BIAS]
    same = pool_flights(
        [FlightInformation(seen, seen[RANGE_BIAS] * 0.35, ALL) for _ in offsets], ROWS
    )
    assert same.mean[RANGE_BIAS] == pytest.approx(0.35, abs=0.01)
    assert same.std[RANGE_BIAS] < 0.3 * USUAL[RANGE_BIAS]


def test_constants_beside_those_asked_for_are_marginalized() -> None:
    rng = np.random.default_rng(2)
    seen, likeliest = draw_information(rng), rng.normal(0, 0.5 * USUAL)
    made = solve(seen, likeliest)
    kept = [k for k, (name, _) in enumerate(SUBJECTS) if name != "height_offset"]
    out = flight_information(made, [SUBJECTS[k] for k in kept], np.arange(len(kept)))
    rest = [k for k in ALL if k not in kept]
    held = seen + np.diag(build_prior(made.constants).curvature())
    wanted = seen[np.ix_(kept, kept)] - seen[np.ix_(kept, rest)] @ np.linalg.solve(
        held[np.ix_(rest, rest)], seen[np.ix_(rest, kept)]
    )
    scale = np.outer(USUAL[kept], USUAL[kept])
    assert out.information * scale == pytest.approx(wanted * scale, rel=1e-6, abs=1e-6)
