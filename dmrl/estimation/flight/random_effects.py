"""What several flights agree on of what each found to be constant.

Every flight tells some combinations of its constants well and others not at all, so each counts
with its whole information, less that of the prior it was solved with. From flight to flight a
constant may change: how much is found with the means, by expectation maximisation of a Gaussian
model with random effects (Laird and Ware 1982).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import Array
from dmrl.estimation.solver.estimate import Estimate
from dmrl.estimation.solver.keyframes import GLOBALS, Noise
from dmrl.estimation.solver.robust_loss import PRIOR, curvature_of, curved

FIRST_SHARE, FIRST_COUNT = 1 / 3, 2.0
"""What is known of the change from flight to flight before any: this share of the prior's standard
deviation, as if seen so often. Two flights that agree by chance do not make it nothing."""
ROUNDS, SETTLED = 200, 1e-3
"""Of expectation maximisation, at most, and the change at which it ends."""
KINDS = np.array([0, 1, 2, 2, 3, 3, 4, 4, 4, 4, 5])
"""Of what is constant, in the order of ``GLOBALS``: what changes alike from flight to flight."""


@dataclass(frozen=True, slots=True)
class Told:
    """What one flight of a pair tells of its constants, apart from the prior.

    Parameters
    ----------
    information
        (G, G) in the order of ``GLOBALS``; positive semi-definite.
    pull
        (G,) the information times the values that are likeliest.
    column
        (G,) which of the means each of them is.
    """

    information: Array
    pull: Array
    column: NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Pooled:
    """M means over flights.

    Parameters
    ----------
    mean
        (M,).
    std
        (M,) of the next flight about it: of the mean, and of the change from flight to flight.
    flights
        (M,) in how many each was solved for.
    """

    mean: Array
    std: Array
    flights: NDArray[np.intp]


def told(estimate: Estimate, column: NDArray[np.intp]) -> Told:
    """What a batch solve tells, apart from the prior of its constants.

    Parameters
    ----------
    estimate
        By the batch solve, so that it has a covariance of its constants.
    column
        (G,) which of the means each of them is.
    """
    assert estimate.constants_covariance is not None
    found, noise = estimate.constants, estimate.noise
    bent = np.linalg.inv(estimate.constants_covariance) - np.diag(curvature_of(noise, found))
    values, vectors = np.linalg.eigh((bent + bent.T) / 2)
    information = (vectors * np.maximum(values, 0.0)) @ vectors.T
    # At the solution the likelihood pulls outwards as hard as the prior pulls back.
    out = found / noise.prior_std()
    prior = out / noise.prior_std() / (1 + out**2 / PRIOR)
    return Told(information, information @ found + prior, column)


def pooled(flights: Sequence[Told], kind: NDArray[np.intp]) -> Pooled:
    """Means of M constants over flights, and how exactly the next flight is known.

    Parameters
    ----------
    flights
        What each tells.
    kind
        (M,) of each constant: which of ``GLOBALS`` it is, any of those that are alike.
    """
    usual, limit, group = Noise().prior_std()[kind], PRIOR[kind], KINDS[kind]
    mean: Array = np.zeros(len(kind))
    change = usual.copy()
    counts = np.bincount(np.concatenate([flight.column for flight in flights]), minlength=len(kind))
    for _ in range(ROUNDS):
        information, pull = _total(flights, change)
        # The prior of one flight's constants: mostly small, and at times not. Where flights tell
        # the difference of two robots alone, it is one of them that is off, not both by half.
        weight = 1 / (1 + (mean / usual) ** 2 / limit) / usual**2
        mean = np.asarray(np.linalg.solve(information + np.diag(weight), pull), float)
        bent = np.diag(curved((mean / usual) ** 2 / limit) / usual**2)
        covariance = np.asarray(np.linalg.pinv(information + bent, hermitian=True), float)
        squares = _squares(flights, mean, covariance, change)
        # What changes alike has one standard deviation, in units of its prior's.
        relative = np.bincount(group, squares / usual**2)
        seen = np.bincount(group, counts) + FIRST_COUNT
        share = np.sqrt((relative + FIRST_COUNT * FIRST_SHARE**2) / seen)
        before, change = change, share[group] * usual
        if np.abs(change / before - 1).max() < SETTLED:
            break
    return Pooled(mean, np.sqrt(np.diag(covariance) + change**2), counts)


def _total(flights: Sequence[Told], change: Array) -> tuple[Array, Array]:
    """(M, M) information of all flights on the means, and (M,) their pull.

    ``change`` (M,) is how much each differs from flight to flight.
    """
    information, pull = np.zeros((len(change),) * 2), np.zeros(len(change))
    for flight in flights:
        spread = np.diag(change[flight.column] ** 2)
        kept = np.linalg.inv(np.eye(len(GLOBALS)) + flight.information @ spread)
        information[np.ix_(flight.column, flight.column)] += kept @ flight.information
        pull[flight.column] += kept @ flight.pull
    return information, pull


def _squares(flights: Sequence[Told], mean: Array, covariance: Array, change: Array) -> Array:
    """(M,) sums over flights of the expected squares of what differs from the means."""
    out = np.zeros(len(mean))
    for flight in flights:
        held = change[flight.column] ** -2.0
        spread = np.linalg.inv(flight.information + np.diag(held))
        found = spread @ (flight.pull + held * mean[flight.column])
        # How unsure the mean is comes in by as much as the flight leaves to it.
        left = spread * held
        own = np.eye(len(held)) - left
        shared = own @ covariance[np.ix_(flight.column, flight.column)] @ own.T
        out[flight.column] += (found - mean[flight.column]) ** 2 + np.diag(spread + shared)
    return out
