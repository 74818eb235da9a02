"""Posterior Cramer-Rao bound of relative positions in a simulated flight.

The bound is the covariance, at the true motion, of a smoother of all robots that knows the
simulator's noise. A range counts with the Fisher information of its whole error density, detours
included. Heights are exact but for their bias. Faults do not count, silent ranges do.

The state of a robot at a step is x, y, yaw in the world and the coloured error of its velocity.
Errors that are constant over the flight form the border of a block-tridiagonal information matrix.
Coloured errors and constants are in units of their standard deviations.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations

import numpy as np

from dmrl.flight.flight_arrays import RATE_HZ, Flight
from dmrl.flight.noise import Noise
from dmrl.geometry.frames import Array

STEP_S = 0.2
"""Time between states, seconds. At 0.05 s bounds of flights in view are smaller by 0.1 %."""
START_STD_M = 1.5
"""Standard deviation of a first position along each axis, metres: the spread of all trajectories.
An estimator knows no more of it, although a trajectory may start at a set distance."""
MIN_WHITE = 1e-3
"""Least white noise of velocity, yaw rate and range, SI units. It keeps the matrices regular."""
STATES, CONSTANTS = 5, 7
"""Number of states of a robot, and of its constants: scale of the velocity, bias of each of its
axes, of the yaw rate and of the height, offset and drift of the clock."""
LEFT = np.array([[0.0, -1.0], [1.0, 0.0]])
"""Rotation by a quarter turn: the effect of a yaw on a vector."""
DENSITY_POINTS = 4001
"""Points of the integral over the density of a range's error. Twice as many change it by 1e-5."""

Link = tuple[str, str]


@dataclass(frozen=True, slots=True)
class PositionBound:
    """Bound on the horizontal position of each peer.

    Parameters
    ----------
    time_s
        (K,) true times, seconds.
    covariances
        By (observer, peer): (K, 2, 2) in the observer's horizontal frame, square metres.
    """

    time_s: Array
    covariances: dict[Link, Array]

    def interpolate_at(self, link: Link, true_time_s: Array) -> Array:
        """Return (N, 2, 2) covariances at true times, linear between steps."""
        entries = self.covariances[link].reshape(-1, 4).T
        columns = [np.interp(true_time_s, self.time_s, entry) for entry in entries]
        return np.stack(columns, axis=1).reshape(-1, 2, 2)


def compute_bound(
    flight: Flight, noise: Noise, yaw_spread_rad: float = np.pi, step_s: float = STEP_S
) -> PositionBound:
    """Compute the bound of a flight. Time and memory are linear in its length.

    Parameters
    ----------
    flight
        The flight.
    noise
        Noise it was simulated with.
    yaw_spread_rad
        First yaws are uniform within plus and minus this.
    step_s
        Time between states, seconds.
    """
    names = list(flight.robots)
    time_s = np.arange(0.0, flight.truth[names[0]].time_s[-1] + step_s / 2, step_s)
    rows, onward, constants = _add_odometry(flight, time_s, noise, yaw_spread_rad)
    d = rows.shape[1]
    for pair, (i, j) in enumerate(combinations(range(len(names)), 2)):
        for link in ((i, j), (j, i)):
            effect = _linearise_ranges(flight, link, pair, time_s, noise)
            rows += effect[:, :d, None] * effect[:, None, :]
            constants += effect[:, d:].T @ effect[:, d:]
    covariance = _invert(rows, onward, constants)
    found = {}
    for i, j in permutations(range(len(names)), 2):
        effect = _linearise_position(flight, (i, j), time_s, noise)
        found[names[i], names[j]] = effect @ covariance @ effect.swapaxes(1, 2)
    return PositionBound(time_s, found)


@lru_cache
def compute_range_information(noise: Noise) -> float:
    """Compute the Fisher information of one range about the distance, 1/m^2.

    The density of the error is that of white noise, plus an exponential detour in a share of the
    ranges.
    """
    white, share, mean = max(noise.uwb_white_m, MIN_WHITE), noise.nlos_share, noise.nlos_mean_m
    error = np.linspace(-8 * white, 8 * white + 12 * mean * (share > 0), DENSITY_POINTS)
    density = np.exp(-((error / white) ** 2) / 2) / (white * np.sqrt(2 * np.pi))
    if share * mean > 0:
        tail = np.exp((error[0] - error) / mean) * (error[1] - error[0]) / mean
        tail[0] /= 2  # trapezoid rule
        density = (1 - share) * density + share * np.convolve(density, tail)[: len(error)]
    slope = np.gradient(density, error)
    return float(np.trapezoid(slope**2 / np.maximum(density, 1e-300), error))


def _add_odometry(
    flight: Flight, time_s: Array, noise: Noise, yaw_spread_rad: float
) -> tuple[Array, Array, Array]:
    """Return the information of odometry, of the first poses and of the priors of constants.

    Returns
    -------
    tuple
        (K, d, d + m) rows of the states, with themselves and the constants, (K, d, d) with the
        next states, and (m, m) of the constants.
    """
    change, weight = _linearise_odometry(flight, time_s, noise)
    _, d, size = change.shape
    back, forth = change[:, :, :d].swapaxes(1, 2) @ weight, weight @ change[:, :, d:]
    rows, onward = np.zeros((len(time_s), d, size)), np.zeros((len(time_s), d, d))
    rows[:-1] += back @ change
    rows[1:, :, :d] += weight
    rows[1:, :, d:] -= forth
    onward[:-1] = -back
    constants = np.eye(size - d) + (change[:, :, d:].swapaxes(1, 2) @ forth).sum(axis=0)
    first = np.ones((d // STATES, STATES))
    first[1:, :3] = START_STD_M, START_STD_M, max(yaw_spread_rad / np.sqrt(3.0), MIN_WHITE)
    first[0, :3] = MIN_WHITE  # all poses are told relative to it
    rows[0, :, :d] += np.diag(first.ravel() ** -2)
    return rows, onward, constants


def _linearise_odometry(flight: Flight, time_s: Array, noise: Noise) -> tuple[Array, Array]:
    """Linearise the motion from step to step. The integral of the coloured error is exact.

    Returns
    -------
    tuple
        (K - 1, d, d + m) effect of the last states and of the constants on the next states, and
        (K - 1, d, d) inverse covariance of the new noise.
    """
    step_s, tau, coloured = time_s[1] - time_s[0], noise.velocity_tau_s, noise.velocity_coloured_mps
    keep = np.exp(-step_s / tau)
    white = [max(w, MIN_WHITE) for w in (noise.velocity_white_mps, noise.yaw_rate_white_radps)]
    place, yawing = np.square(white) * step_s / RATE_HZ
    place += 2 * coloured**2 * tau * (step_s - 2 * tau * (1 - keep) + tau * (1 - keep**2) / 2)
    d, size = _count_unknowns(flight)
    change = np.zeros((len(time_s) - 1, d, size))
    weight = np.zeros((len(time_s) - 1, d, d))
    for k, truth in enumerate(flight.truth.values()):
        own, fixed = slice(STATES * k, STATES * (k + 1)), d + CONSTANTS * k
        moved = np.diff(truth.position_at(time_s)[:, :2], axis=0)
        turn = _rotate(truth.yaw_at((time_s[1:] + time_s[:-1]) / 2))
        effect = change[:, own]
        effect[:, :, own] = np.diag([1.0, 1.0, 1.0, keep, keep])
        effect[:, :2, own.start + 2] = moved @ LEFT.T
        effect[:, :2, own.start + 3 : own.stop] = -coloured * tau * (1 - keep) * turn
        effect[:, :2, fixed] = -noise.velocity_scale * moved
        effect[:, :2, fixed + 1 : fixed + 3] = -noise.velocity_bias_mps * step_s * turn
        effect[:, 2, fixed + 3] = -noise.yaw_rate_bias_radps * step_s
        spread = np.tile(
            np.diag([place, place, yawing, 1 - keep**2, 1 - keep**2]), (len(turn), 1, 1)
        )
        spread[:, :2, 3:] = -coloured * tau * (1 - keep) ** 2 * turn
        spread[:, 3:, :2] = spread[:, :2, 3:].swapaxes(1, 2)
        weight[:, own, own] = np.linalg.inv(spread)
    return change, weight


def _count_unknowns(flight: Flight) -> tuple[int, int]:
    """Return the number of states of a step, and that with the constants of robots and pairs."""
    robots = len(flight.robots)
    return STATES * robots, (STATES + CONSTANTS + robots - 1) * robots


def _rotate(angle: Array) -> Array:
    """Return (K, 2, 2) rotations of the plane."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)


def _linearise_away(flight: Flight, link: tuple[int, int], time_s: Array, noise: Noise) -> Array:
    """Return (K, 2, d + m) effects on the place of a peer from the observer, world frame.

    The time of the observer's clock counts, so offset and drift of the peer's clock move it.
    """
    d, size = _count_unknowns(flight)
    effect = np.zeros((len(time_s), 2, size))
    truth = list(flight.truth.values())[link[1]]
    velocity = np.stack([np.interp(time_s, truth.time_s, v) for v in truth.velocity.T[:2]], axis=1)
    for robot, sign in zip(link, (-1.0, 1.0), strict=True):
        effect[:, :, STATES * robot : STATES * robot + 2] = sign * np.eye(2)
        if robot:  # the first robot's clock is true
            clock = d + CONSTANTS * robot + 5
            effect[:, :, clock] = sign * noise.clock_offset_s / np.sqrt(3.0) * velocity
            effect[:, :, clock + 1] = (
                sign * noise.clock_drift_ppm * 1e-6 * time_s[:, None] * velocity
            )
    return effect


def _linearise_ranges(
    flight: Flight, link: tuple[int, int], pair: int, time_s: Array, noise: Noise
) -> Array:
    """Return (K, d + m) effects on the ranges of one robot to another near each step, whitened."""
    names, truths = list(flight.robots), list(flight.truth.values())
    away = truths[link[1]].position_at(time_s) - truths[link[0]].position_at(time_s)
    distance = np.maximum(np.linalg.norm(away, axis=1), 0.01)
    toward = away[:, None, :2] / distance[:, None, None]
    effect = (toward @ _linearise_away(flight, link, time_s, noise))[:, 0]
    heights = [STATES * len(names) + CONSTANTS * robot + 4 for robot in link]
    effect[:, heights] = np.outer(noise.height_bias_m * away[:, 2] / distance, [-1.0, 1.0])
    own = (STATES + CONSTANTS) * len(names) + 2 * pair
    effect[:, own], effect[:, own + 1] = noise.uwb_bias_m, noise.uwb_scale * distance
    name = names[link[0]]
    true_s = flight.clocks[name].to_true_time(flight.ranges[name, names[link[1]]].time_s)
    nearest = np.clip(np.rint(true_s / time_s[1]).astype(int), 0, len(time_s) - 1)
    number = np.bincount(nearest, minlength=len(time_s))
    return np.asarray(effect * np.sqrt(number * compute_range_information(noise))[:, None])


def _linearise_position(
    flight: Flight, link: tuple[int, int], time_s: Array, noise: Noise
) -> Array:
    """Return (K, 2, d + m) effects on a peer's position in the observer's horizontal frame."""
    names = list(flight.robots)
    yaw = flight.truth[names[link[0]]].yaw_at(time_s)
    effect = _rotate(-yaw) @ _linearise_away(flight, link, time_s, noise)
    place = flight.peer_in_horizontal(names[link[0]], names[link[1]], time_s)[:, :2]
    effect[:, :, STATES * link[0] + 2] -= place @ LEFT.T
    return np.asarray(effect)


def _invert(rows: Array, onward: Array, constants: Array) -> Array:
    """Return (K, d + m, d + m) covariances of the states of each step and the constants.

    States are eliminated forwards; their covariances follow backwards from those of the constants.
    """
    count, d, size = rows.shape
    gain = np.zeros_like(rows)
    for k in range(count):
        rows[k, :, :d] = np.linalg.inv(rows[k, :, :d])
        gain[k] = rows[k, :, :d] @ np.hstack([onward[k], rows[k, :, d:]])
        constants = constants - rows[k, :, d:].T @ gain[k, :, d:]
        if k + 1 < count:
            rows[k + 1] -= onward[k].T @ gain[k]
    joint = np.zeros((count + 1, size, size))
    joint[-1, d:, d:] = np.linalg.inv(constants)
    for k in reversed(range(count)):
        carry = np.eye(size)
        carry[:d] = -gain[k]
        joint[k] = carry @ joint[k + 1] @ carry.T
        joint[k, :d, :d] += rows[k, :, :d]
    return joint[:-1]
