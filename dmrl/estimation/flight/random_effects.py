"""Pool the constants of several flights.

Every flight determines some combinations of its constants well and others not at all. So each one
contributes its whole information matrix, minus the prior it was solved with. A constant may change
from flight to flight. That variance is estimated together with the means, by expectation
maximization of a Gaussian model with random effects (Laird and Ware 1982).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.layout import Subject
from dmrl.estimation.solver.priors import ConstantPrior
from dmrl.estimation.solver.unknowns import Unknown

PRIOR_STD_SHARE, PRIOR_FLIGHTS = 1 / 3, 2.0
"""Prior of the change from flight to flight: share of the prior's standard deviation, and its
weight in flights. It keeps two flights that agree by chance from making the change zero. No record
of how the values were chosen."""
MAX_ROUNDS, TOLERANCE = 200, 1e-3
"""Largest number of EM iterations, and the relative change that ends them. No record of how the
values were chosen."""


@dataclass(frozen=True, slots=True)
class FlightInformation:
    """Information of one flight of a pair about its constants, without the prior.

    Parameters
    ----------
    information
        (G, G); positive semi-definite.
    information_vector
        (G,) the information times the likeliest values.
    column
        (G,) index of the mean of each constant.
    """

    information: Array
    information_vector: Array
    column: NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class PooledConstants:
    """Means of M constants over flights.

    Parameters
    ----------
    mean
        (M,) means.
    std
        (M,) of the next flight about the mean: of the mean, and of the change from flight to
        flight.
    flights
        (M,) number of flights with each constant.
    """

    mean: Array
    std: Array
    flights: NDArray[np.intp]


def flight_information(
    estimate: Estimate, subjects: Sequence[Subject], column: NDArray[np.intp]
) -> FlightInformation:
    """Return the information of a batch solve about some constants, without their prior.

    Parameters
    ----------
    estimate
        Estimate of the batch solve, which has a covariance of the constants.
    subjects
        The G constants.
    column
        (G,) index of the mean of each constant.
    """
    assert estimate.constants_covariance is not None
    layout, found = estimate.layout, estimate.constants
    std = estimate.noise.prior_std(layout)
    prior = ConstantPrior(found, std, tuple(row.loss for _, row in layout.constants))
    kept = np.array([layout.find(name, *robots) for name, robots in subjects])
    # The other constants keep their priors and are marginalized.
    spread = estimate.constants_covariance[np.ix_(kept, kept)]
    bent = np.linalg.inv(spread) - np.diag(prior.curvature()[kept])
    values, vectors = np.linalg.eigh((bent + bent.T) / 2)
    information = (vectors * np.maximum(values, 0.0)) @ vectors.T
    # At the solution the gradients of likelihood and prior cancel.
    pull = (prior.information() * found)[kept]
    return FlightInformation(information, information @ found[kept] + pull, column)


def pool_flights(flights: Sequence[FlightInformation], rows: Sequence[Unknown]) -> PooledConstants:
    """Pool M constants over flights, with the standard deviation of the next flight.

    Parameters
    ----------
    flights
        Information of each flight.
    rows
        (M,) row of each constant. Constants with equal unit and owner share one relative change.
    """
    usual, losses = np.array([row.std for row in rows]), tuple(row.loss for row in rows)
    kinds = [(row.unit, row.owner) for row in rows]
    group = np.array([sorted(set(kinds)).index(kind) for kind in kinds])
    mean: Array = np.zeros(len(rows))
    change = usual.copy()
    counts = np.bincount(np.concatenate([flight.column for flight in flights]), minlength=len(rows))
    for _ in range(MAX_ROUNDS):
        information, pull = _total_information(flights, change)
        # The heavy-tailed prior of a single flight. If flights determine only the difference of
        # two robots, it attributes the whole error to one of them.
        weight = ConstantPrior(mean, usual, losses).information()
        mean = np.asarray(np.linalg.solve(information + np.diag(weight), pull), float)
        bent = np.diag(ConstantPrior(mean, usual, losses).curvature())
        covariance = np.asarray(np.linalg.pinv(information + bent, hermitian=True), float)
        squares = _sum_expected_squares(flights, mean, covariance, change)
        # A group has one standard deviation, relative to that of the prior.
        relative = np.bincount(group, squares / usual**2)
        seen = np.bincount(group, counts) + PRIOR_FLIGHTS
        share = np.sqrt((relative + PRIOR_FLIGHTS * PRIOR_STD_SHARE**2) / seen)
        before, change = change, share[group] * usual
        if np.abs(change / before - 1).max() < TOLERANCE:
            break
    return PooledConstants(mean, np.sqrt(np.diag(covariance) + change**2), counts)


def _total_information(flights: Sequence[FlightInformation], change: Array) -> tuple[Array, Array]:
    """Return (M, M) information of all flights about the means, and its vector (M,).

    ``change`` (M,) is the standard deviation of each constant from flight to flight.
    """
    information, pull = np.zeros((len(change),) * 2), np.zeros(len(change))
    for flight in flights:
        spread = np.diag(change[flight.column] ** 2)
        kept = np.linalg.inv(np.eye(len(spread)) + flight.information @ spread)
        information[np.ix_(flight.column, flight.column)] += kept @ flight.information
        pull[flight.column] += kept @ flight.information_vector
    return information, pull


def _sum_expected_squares(
    flights: Sequence[FlightInformation], mean: Array, covariance: Array, change: Array
) -> Array:
    """Return (M,) sums over flights of the expected squared deviations from the means."""
    out = np.zeros(len(mean))
    for flight in flights:
        held = change[flight.column] ** -2.0
        spread = np.linalg.inv(flight.information + np.diag(held))
        found = spread @ (flight.information_vector + held * mean[flight.column])
        # The covariance of the mean enters by the weight that the flight leaves to the mean.
        left = spread * held
        own = np.eye(len(held)) - left
        shared = own @ covariance[np.ix_(flight.column, flight.column)] @ own.T
        out[flight.column] += (found - mean[flight.column]) ** 2 + np.diag(spread + shared)
    return out
