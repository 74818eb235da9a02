"""Select the positions that are precise enough to label.

A limit on sigma passes positions just below it. A flight that is just below it throughout then has
too many bad labels. Therefore each flight has a budget: positions are accepted in the order of
their probability of being bad, as long as the expected share of bad ones stays small.
"""

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.gate import DEFAULT_GATE, Gate
from dmrl.estimation.model.pair import Array, Mask

OK, UNCONVERGED, AMBIGUOUS = range(3)
"""Values of ``status``, equal to those of ``dmrl.v1.Status``."""

MAX_BEARING_SIGMA_RAD, MAX_MEDIAN_BEARING_SIGMA_RAD = 0.35, 0.25
"""Largest sigma over distance of an observable bearing; and largest median of it over a flight.
Above the median, the motion of the whole flight leaves the bearing open. No record of how the
values were chosen."""
MIN_DISTANCE_M = 0.5
"""Smallest distance in sigma over distance, metres. Robots do not fly nearer, and the ratio would
diverge. No record of how the value was chosen."""
DIRECTION_COUNT = 64
"""Number of directions in the sum of `probability_beyond`. It gives three digits while one sigma is
up to some twenty times the other."""

Statuses = NDArray[np.int8]


def classify_positions(state: Array, covariance: Array, gate: Gate = DEFAULT_GATE) -> Statuses:
    """Return (K,) the status of every position, from its covariance.

    Parameters
    ----------
    state
        (K, 3) x, y (m), psi (rad).
    covariance
        (K, 3, 3) of the state.
    gate
        Gate of the positions.
    """
    xy, spread = state[:, :2], covariance[:, :2, :2]
    good = select_within_budget(probability_beyond(spread, gate.error_m), gate.bad_share)
    status = np.where(good, OK, UNCONVERGED).astype(np.int8)
    sigma_m = np.sqrt(np.linalg.eigvalsh(spread)[:, -1])
    bearing_rad = sigma_m / np.maximum(np.hypot(*xy.T), MIN_DISTANCE_M)
    whole = not np.median(bearing_rad) < MAX_MEDIAN_BEARING_SIGMA_RAD
    status[whole | ~(bearing_rad < MAX_BEARING_SIGMA_RAD)] = AMBIGUOUS
    return status


def probability_beyond(covariance: Array, error_m: float) -> Array:
    """Return (K,) the probability that a Gaussian error is longer than a limit.

    In a direction with inverse covariance q the length has a Rayleigh distribution: P(length > r) =
    exp(-q r^2 / 2). The mean over directions is weighted by 1 / q, the density of errors in that
    direction.

    Parameters
    ----------
    covariance
        (K, 2, 2) of the error, square metres.
    error_m
        The limit, metres.
    """
    small, large = np.maximum(np.linalg.eigvalsh(covariance), 1e-8).T
    beyond, total = np.zeros((2, len(covariance)))
    for angle in (np.arange(DIRECTION_COUNT) + 0.5) * np.pi / DIRECTION_COUNT:
        q = np.cos(angle) ** 2 / small + np.sin(angle) ** 2 / large
        weight = 1 / q
        total += weight
        beyond += weight * np.exp(-q * error_m**2 / 2)
    return beyond / total


def select_within_budget(probability: Array, share: float) -> Mask:
    """Return (K,) the largest set of best positions whose mean probability is within the budget.

    Parameters
    ----------
    probability
        (K,) probability of being bad.
    share
        Budget: the largest mean.
    """
    ordered = np.sort(probability)
    mean = np.cumsum(ordered) / np.arange(1, len(ordered) + 1)
    count = int(np.searchsorted(mean, share, "right"))
    limit = float(ordered[count - 1]) if count else -1.0
    return np.asarray(probability <= limit)
