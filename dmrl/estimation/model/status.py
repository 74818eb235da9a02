"""Which positions are good enough to label.

A limit on sigma passes what lies just below it, and where a whole flight does, too many of its
labels are bad. So each flight has a budget instead: the best positions are taken for as long as
few enough of them are expected to be far off.
"""

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.pair import Array, Mask

OK, UNCONVERGED, AMBIGUOUS = range(3)
"""Values of ``status``; the same as in ``dmrl.v1.Status``."""

GATE_M = 0.3
"""A position that is off by more than this is a bad one."""
EXPECTED_SHARE = 0.045
"""Share of a flight's OK positions that may be expected to be bad. Most flights with calibrated
sensors are good from end to end and spend little of it: over all of them it is below 1 %."""
WORST_SHARE = 0.12
"""Probability of being bad that no OK position exceeds."""
OPEN_RAD, OPEN_FLIGHT_RAD = 0.35, 0.25
"""Sigma over distance beyond which a bearing is open rather than imprecise; and the median
over a flight beyond which the motion of the whole flight leaves it open."""
NEAR_M = 0.5
"""Distances are taken as at least this: nearer, no one flies and any sigma is an angle."""
ANGLES = 64
"""Directions over which a probability is summed: three digits while one sigma is up to some
twenty times the other."""

Statuses = NDArray[np.int8]


def statuses(state: Array, covariance: Array, gate_m: float) -> Statuses:
    """(K,) from the covariance.

    Parameters
    ----------
    state
        (K, 3) x, y (m), psi (rad).
    covariance
        (K, 3, 3) of the state.
    gate_m
        A position that is off by more than this is a bad one, metres.
    """
    xy, spread = state[:, :2], covariance[:, :2, :2]
    good = within_budget(probability_beyond(spread, gate_m), EXPECTED_SHARE)
    status = np.where(good, OK, UNCONVERGED).astype(np.int8)
    sigma_m = np.sqrt(np.linalg.eigvalsh(spread)[:, -1])
    bearing_rad = sigma_m / np.maximum(np.hypot(*xy.T), NEAR_M)
    whole = not np.median(bearing_rad) < OPEN_FLIGHT_RAD
    status[whole | ~(bearing_rad < OPEN_RAD)] = AMBIGUOUS
    return status


def probability_beyond(covariance: Array, error_m: float) -> Array:
    """(K,) probability that a normal error is longer than a limit.

    In a direction where the inverse covariance is q the length is Rayleigh's: exp(-q r^2 / 2).
    The mean over directions weighs each by how often an error points there, 1 / q.

    Parameters
    ----------
    covariance
        (K, 2, 2) of the error, square metres.
    error_m
        The limit, metres.
    """
    small, large = np.maximum(np.linalg.eigvalsh(covariance), 1e-8).T[..., None]
    angle = (np.arange(ANGLES) + 0.5) * np.pi / ANGLES
    q = np.cos(angle) ** 2 / small + np.sin(angle) ** 2 / large
    weight = 1 / q
    beyond = (weight * np.exp(-q * error_m**2 / 2)).sum(axis=1)
    return np.asarray(beyond / weight.sum(axis=1))


def within_budget(probability: Array, share: float) -> Mask:
    """(K,) the largest set of the best whose mean probability of being bad is small enough.

    Parameters
    ----------
    probability
        (K,) of being bad.
    share
        The largest mean.
    """
    ordered = np.sort(probability)
    mean = np.cumsum(ordered) / np.arange(1, len(ordered) + 1)
    count = int(np.searchsorted(mean, share, "right"))
    limit = min(float(ordered[count - 1]), WORST_SHARE) if count else -1.0
    return np.asarray(probability <= limit)
