from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.flight.random_effects import (
    FlightInformation,
    flight_information,
    pool_flights,
)
from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import GLOBALS, NoiseModel
from dmrl.estimation.solver.residuals import OWN_GYRO, PEER_GYRO, RANGE_BIAS
from dmrl.estimation.solver.robust_loss import PRIOR_LOSS_SCALES, prior_curvature

SIZE = len(GLOBALS)
ALL = np.arange(SIZE)
USUAL = NoiseModel().prior_std()


def information(rng: np.random.Generator, rank: int = SIZE) -> Array:
    """Of a flight that tells so many combinations of its constants, some well and some hardly."""
    rows = rng.normal(size=(rank, SIZE)) * rng.uniform(0.3, 10, (rank, 1)) / USUAL
    return np.asarray(rows.T @ rows)


def solved(seen: Array, likeliest: Array) -> Estimate:
    """What a solve says of a flight, whose prior holds the constants back."""
    noise, found = NoiseModel(), np.zeros(SIZE)
    for _ in range(200):
        weight = 1 / (1 + (found / USUAL) ** 2 / PRIOR_LOSS_SCALES) / USUAL**2
        found = np.linalg.solve(seen + np.diag(weight), seen @ likeliest)
    covariance = np.linalg.inv(seen + np.diag(prior_curvature(noise, found)))
    state, spread, status = np.zeros((2, 3)), np.stack([np.eye(3)] * 2), np.zeros(2, np.int8)
    made = Estimate(np.arange(2.0), state, spread, status, found, noise)
    return replace(made, constants_covariance=covariance)


def test_a_flight_tells_what_it_does_without_its_prior() -> None:
    rng = np.random.default_rng(0)
    seen, likeliest = information(rng), rng.normal(0, 0.5 * USUAL)
    out = flight_information(solved(seen, likeliest), ALL)
    scale = np.outer(USUAL, USUAL)
    assert out.information * scale == pytest.approx(seen * scale, rel=1e-6, abs=1e-6)
    assert out.information_vector * USUAL == pytest.approx(seen @ likeliest * USUAL, rel=1e-4)


def test_the_next_flight_is_as_far_off_as_is_said() -> None:
    """Of many labs, whose robots' constants stay but for a little, as in their priors' units."""
    rng = np.random.default_rng(1)
    off = []
    for _ in range(60):
        own = rng.normal(0, USUAL)
        flights = [own + rng.normal(0, 0.3 * USUAL) for _ in range(6)]
        seen = [information(rng) for _ in flights]
        parts = [
            FlightInformation(one, one @ flight, ALL)
            for one, flight in zip(seen, flights, strict=True)
        ]
        found = pool_flights(parts, ALL)
        assert (found.flights == 5).sum() == 0
        off.append((own + rng.normal(0, 0.3 * USUAL) - found.mean) / found.std)
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.25


def test_where_a_difference_alone_is_told_one_robot_is_off() -> None:
    row = np.zeros(SIZE)
    row[OWN_GYRO], row[PEER_GYRO] = -1e4, 1e4
    seen = np.outer(row, row)
    true = np.zeros(SIZE)
    true[PEER_GYRO] = 0.05
    # Of a third robot too: who is in both pairs is the one.
    columns = [ALL, np.where(ALL == OWN_GYRO, SIZE, ALL)]
    kind = np.append(ALL, OWN_GYRO)
    found = pool_flights([FlightInformation(seen, seen @ true, column) for column in columns], kind)
    assert found.mean[PEER_GYRO] == pytest.approx(0.05, abs=0.003)
    assert found.mean[[OWN_GYRO, SIZE]] == pytest.approx(0.0, abs=0.003)


def test_what_is_another_every_time_is_not_known() -> None:
    seen = np.zeros((SIZE, SIZE))
    seen[RANGE_BIAS, RANGE_BIAS] = 1e6
    offsets = [-0.4, 0.5, 0.1, -0.3, 0.45, -0.35]
    found = pool_flights(
        [FlightInformation(seen, seen[RANGE_BIAS] * offset, ALL) for offset in offsets], ALL
    )
    assert found.std[RANGE_BIAS] > USUAL[RANGE_BIAS]
    same = pool_flights(
        [FlightInformation(seen, seen[RANGE_BIAS] * 0.35, ALL) for _ in offsets], ALL
    )
    assert same.mean[RANGE_BIAS] == pytest.approx(0.35, abs=0.01)
    assert same.std[RANGE_BIAS] < 0.3 * USUAL[RANGE_BIAS]
