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

from dmrl.flight.flight_arrays import RATE_HZ, Flight, Truth
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


@dataclass(slots=True)
class _Information:
    """Blocks of the information matrix, or of what elimination makes of them.

    ``steps`` (K, d, d), ``next_step`` (K - 1, d, d), ``border`` (K, d, m), ``constants`` (m, m).
    """

    steps: Array
    next_step: Array
    border: Array
    constants: Array


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
    robots = list(flight.robots)
    end_s = flight.truth[robots[0]].time_s[-1]
    time_s = np.arange(0.0, end_s + step_s / 2, step_s)
    information = _build_odometry(flight, time_s, noise, yaw_spread_rad)
    for pair, (i, j) in enumerate(combinations(range(len(robots)), 2)):
        for one, other in ((i, j), (j, i)):
            _add_ranges(information, flight, (one, other), pair, time_s, noise)
    covariance = _invert(information)
    links = permutations(range(len(robots)), 2)
    return PositionBound(
        time_s,
        {
            (robots[i], robots[j]): _position_covariance(covariance, flight, (i, j), time_s, noise)
            for i, j in links
        },
    )


def count_bound_bytes(robots: int, duration_s: float) -> float:
    """Return the memory that the bound of a flight takes, bytes."""
    d, m = STATES * robots, CONSTANTS * robots + robots * (robots - 1)
    return 8 * duration_s / STEP_S * d * (2 * d + m)


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
        step = error[1] - error[0]
        tail = np.exp((error[0] - error) / mean) * step / mean
        tail[0] /= 2  # trapezoid rule
        density = (1 - share) * density + share * np.convolve(density, tail)[: len(error)]
    slope = np.gradient(density, error)
    return float(np.trapezoid(slope**2 / np.maximum(density, 1e-300), error))


def _build_odometry(
    flight: Flight, time_s: Array, noise: Noise, yaw_spread_rad: float
) -> _Information:
    """Build the information of odometry, of the first poses and of the priors of constants."""
    count, robots = len(time_s), len(flight.robots)
    d, m = STATES * robots, CONSTANTS * robots + robots * (robots - 1)
    built = _Information(
        np.zeros((count, d, d)), np.zeros((count - 1, d, d)), np.zeros((count, d, m)), np.eye(m)
    )
    yaw_std = max(yaw_spread_rad / np.sqrt(3.0), MIN_WHITE)
    for k, truth in enumerate(flight.truth.values()):
        own, mine = slice(STATES * k, STATES * (k + 1)), slice(CONSTANTS * k, CONSTANTS * (k + 1))
        first = [START_STD_M, START_STD_M, yaw_std] if k else [MIN_WHITE] * 3
        built.steps[0, own, own] += np.diag(np.array([*first, 1.0, 1.0]) ** -2)
        change, effect, spread = _linearise_odometry(truth, time_s, noise)
        weight = np.linalg.inv(spread)
        back = np.swapaxes(change, 1, 2) @ weight
        built.steps[1:, own, own] += weight
        built.steps[:-1, own, own] += back @ change
        built.next_step[:, own, own] -= back
        built.border[1:, own, mine] -= weight @ effect
        built.border[:-1, own, mine] += back @ effect
        built.constants[mine, mine] += (np.swapaxes(effect, 1, 2) @ weight @ effect).sum(axis=0)
    return built


def _linearise_odometry(truth: Truth, time_s: Array, noise: Noise) -> tuple[Array, Array, Array]:
    """Linearise one robot's motion from step to step.

    Returns
    -------
    tuple
        (K - 1, 5, 5) effect of the last state, (K - 1, 5, 7) effect of the constants, and
        (K - 1, 5, 5) covariance of what is new. The integral of the coloured error is exact.
    """
    x, y = np.diff(truth.position_at(time_s)[:, :2], axis=0).T
    yaw, step_s = truth.yaw_at((time_s[1:] + time_s[:-1]) / 2), time_s[1] - time_s[0]
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)
    tau, coloured = noise.velocity_tau_s, noise.velocity_coloured_mps
    keep = np.exp(-step_s / tau)
    change = np.tile(np.diag([1.0, 1.0, 1.0, keep, keep]), (len(x), 1, 1))
    change[:, :2, 2] = np.stack([-y, x], axis=1)
    change[:, :2, 3:] = -coloured * tau * (1 - keep) * turn
    effect = np.zeros((len(x), STATES, CONSTANTS))
    effect[:, :2, 0] = -noise.velocity_scale * np.stack([x, y], axis=1)
    effect[:, :2, 1:3] = -noise.velocity_bias_mps * step_s * turn
    effect[:, 2, 3] = -noise.yaw_rate_bias_radps * step_s
    white = [max(w, MIN_WHITE) for w in (noise.velocity_white_mps, noise.yaw_rate_white_radps)]
    place, yawing = np.square(white) * step_s / RATE_HZ
    place += 2 * coloured**2 * tau * (step_s - 2 * tau * (1 - keep) + tau * (1 - keep**2) / 2)
    spread = np.tile(np.diag([place, place, yawing, 1 - keep**2, 1 - keep**2]), (len(x), 1, 1))
    spread[:, :2, 3:] = -coloured * tau * (1 - keep) ** 2 * turn
    spread[:, 3:, :2] = np.swapaxes(spread[:, :2, 3:], 1, 2)
    return change, effect, spread


def _relative_rows(flight: Flight, link: tuple[int, int], time_s: Array, noise: Noise) -> Array:
    """Return (K, 2, d + m) effects on where a peer is in the world, from the observer.

    The time of the observer's clock counts, so offset and drift of the peer's clock move it.
    """
    robots = len(flight.robots)
    d, m = STATES * robots, CONSTANTS * robots + robots * (robots - 1)
    rows = np.zeros((len(time_s), 2, d + m))
    truth = list(flight.truth.values())[link[1]]
    velocity = np.stack([np.interp(time_s, truth.time_s, v) for v in truth.velocity.T[:2]], axis=1)
    for robot, sign in zip(link, (-1.0, 1.0), strict=True):
        rows[:, :, STATES * robot : STATES * robot + 2] = sign * np.eye(2)
        if robot:  # the first robot's clock is true
            at = d + CONSTANTS * robot
            rows[:, :, at + 5] = sign * noise.clock_offset_s / np.sqrt(3.0) * velocity
            rows[:, :, at + 6] = sign * noise.clock_drift_ppm * 1e-6 * time_s[:, None] * velocity
    return rows


def _add_ranges(
    information: _Information,
    flight: Flight,
    link: tuple[int, int],
    pair: int,
    time_s: Array,
    noise: Noise,
) -> None:
    """Add the ranges of one robot to another, each at its nearest step."""
    names, truths = list(flight.robots), list(flight.truth.values())
    (i, j), robots = link, len(names)
    away = truths[j].position_at(time_s) - truths[i].position_at(time_s)
    distance = np.maximum(np.linalg.norm(away, axis=1), 0.01)
    rows = np.einsum(
        "ka,kas->ks", away[:, :2] / distance[:, None], _relative_rows(flight, link, time_s, noise)
    )
    d = STATES * robots
    lift = noise.height_bias_m * away[:, 2] / distance
    rows[:, d + CONSTANTS * j + 4] += lift
    rows[:, d + CONSTANTS * i + 4] -= lift
    own = d + CONSTANTS * robots + 2 * pair
    rows[:, own], rows[:, own + 1] = noise.uwb_bias_m, noise.uwb_scale * distance
    ranges = flight.ranges[names[i], names[j]]
    true_s = flight.clocks[names[i]].to_true_time(ranges.time_s)
    nearest = np.clip(np.rint(true_s / (time_s[1] - time_s[0])).astype(int), 0, len(time_s) - 1)
    number = np.bincount(nearest, minlength=len(time_s))
    rows *= np.sqrt(number * compute_range_information(noise))[:, None]
    state, constant = rows[:, :d], rows[:, d:]
    information.steps += state[:, :, None] * state[:, None, :]
    information.border += state[:, :, None] * constant[:, None, :]
    information.constants += constant.T @ constant


def _invert(information: _Information) -> _Information:
    """Return the blocks of the inverse in the same form, in the same memory.

    Steps are eliminated forwards, then the covariances found backwards. ``next_step`` and
    ``border`` hold the gains of each step on the next and on the constants in between.
    """
    steps, onward, border = information.steps, information.next_step, information.border
    constants, last = information.constants, len(steps) - 1
    for k in range(last + 1):
        inverse = np.linalg.inv(steps[k])
        on_constants = inverse @ border[k]
        constants = constants - border[k].T @ on_constants
        if k < last:
            on_next = inverse @ onward[k]
            steps[k + 1] -= onward[k].T @ on_next
            border[k + 1] -= onward[k].T @ on_constants
            onward[k] = on_next
        steps[k], border[k] = inverse, on_constants
    constants = np.asarray(np.linalg.inv(constants), float)
    for k in range(last, -1, -1):
        gain, shared = border[k], -border[k] @ constants
        if k < last:
            on_next, after = onward[k], border[k + 1]
            shared -= on_next @ after
            steps[k] += (on_next @ steps[k + 1] + gain @ after.T) @ on_next.T
        steps[k] -= shared @ gain.T
        border[k] = shared
    return _Information(steps, onward, border, constants)


def _position_covariance(
    covariance: _Information, flight: Flight, link: tuple[int, int], time_s: Array, noise: Noise
) -> Array:
    """Return (K, 2, 2) covariances of a peer in the observer's horizontal frame."""
    names, (i, j) = list(flight.robots), link
    yaw, rows = flight.truth[names[i]].yaw_at(time_s), _relative_rows(flight, link, time_s, noise)
    x, y, _ = flight.peer_in_horizontal(names[i], names[j], time_s).T
    cos, sin = np.cos(yaw), np.sin(yaw)
    rows = np.array([[cos, sin], [-sin, cos]]).transpose(2, 0, 1) @ rows
    rows[:, :, STATES * i + 2] += np.stack([y, -x], axis=1)
    d = covariance.steps.shape[1]
    state, constant = rows[:, :, :d], rows[:, :, d:]
    mixed = state @ covariance.border @ constant.swapaxes(1, 2)
    own = state @ covariance.steps @ state.swapaxes(1, 2)
    return (
        own
        + mixed
        + mixed.swapaxes(1, 2)
        + constant @ covariance.constants @ constant.swapaxes(1, 2)
    )
