"""Estimated trajectory of a peer, and the same trajectory from the other robot."""

from dataclasses import dataclass, replace

import numpy as np

from dmrl.estimation.model.odometry import QUARTER_TURN, rotate, rotation_matrix
from dmrl.estimation.model.pair import Array
from dmrl.estimation.model.status import UNCONVERGED, Statuses
from dmrl.estimation.solver.layout import Layout, build_layout, from_peer
from dmrl.estimation.solver.problem import NoiseModel
from dmrl.estimation.solver.unknowns import TABLE

PAIR_LAYOUT: Layout = build_layout(TABLE, 2, [(0, 1)])
"""Columns of a pair without detections."""


REASONS = {
    "still": "robot hardly moves",
    "alike": "robots move alike",
    "silent": "sensors are silent",
    "open": "bearing is open",
    "imprecise": "positions are imprecise",
}
"""Names of the reasons why no position of a flight is OK."""
MISFIT = "does not fit"
"""End of the name of a cause that refuses its stretch: a signal that no error model explains."""
TOO_NOISY = "odometry is too noisy"
"""Name of a cause that refuses its stretch: constants cannot be told from such noise."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Error of a sensor that a flight shows.

    Parameters
    ----------
    name
        Name of its model.
    probability
        Probability of the error, 0 to 1.
    from_s, to_s
        Times between which it is seen, seconds.
    robot
        0: the observer's sensor, 1: the peer's. None: the pair's.
    """

    name: str
    probability: float
    from_s: float
    to_s: float
    robot: int | None = None

    @property
    def refuses(self) -> bool:
        """Whether no position of its stretch may be OK."""
        return self.name.endswith(MISFIT) or self.name == TOO_NOISY

    def seen_from_peer(self) -> "Cause":
        """Return the cause with observer and peer exchanged."""
        return self if self.robot is None else replace(self, robot=1 - self.robot)


@dataclass(frozen=True, slots=True)
class Innovation:
    """Size of the misfit of a signal, over windows.

    Parameters
    ----------
    signal
        range, flow, yaw rate, bearing or height.
    time_s
        (W,) middles of the windows, seconds.
    size
        (W,) roots of chi-square over its degrees of freedom; about 1 if the model is true.
    robot
        0: the observer's sensor, 1: the peer's. None: the pair's.
    """

    signal: str
    time_s: Array
    size: Array
    robot: int | None = None

    def seen_from_peer(self) -> "Innovation":
        """Return the innovation with observer and peer exchanged."""
        return self if self.robot is None else replace(self, robot=1 - self.robot)


@dataclass(frozen=True, slots=True)
class Estimate:
    """Trajectory of a peer over a flight, K keyframes or steps. The observer is robot 0.

    Parameters
    ----------
    time_s
        (K,) times, seconds.
    state
        (K, 3) x, y (m) in the observer's horizontal frame, heading psi (rad).
    covariance
        (K, 3, 3) of the state.
    status
        (K,) OK, UNCONVERGED (not precise enough to label) or AMBIGUOUS (more than one solution).
    constants
        (G,) constants of the flight, in the order of ``layout``; zeros if the method estimates
        none.
    noise
        Selected noise model of the sensors.
    layout
        Columns of the constants.
    height_m, height_std_m
        (K,) error of the measured height difference, metres, and its standard deviation. None: not
        estimated.
    range_error_m
        (K,) temporary excess of the ranges, as behind an obstacle, metres. None: not estimated.
    clock_s, clock_variance
        (K,) seconds by which the peer's clock is ahead of the observer's, by the peer's motion,
        and their variances. None: not estimated.
    constants_covariance
        (G, G) of the constants. None: not estimated.
    modes
        Number of solutions of nearly equal probability that the covariance contains.
    causes
        Errors of sensors that the flight shows, and a reason if no position is OK.
    innovations
        What every signal shows beyond the model.
    """

    time_s: Array
    state: Array
    covariance: Array
    status: Statuses
    constants: Array
    noise: NoiseModel
    layout: Layout = PAIR_LAYOUT
    height_m: Array | None = None
    height_std_m: Array | None = None
    range_error_m: Array | None = None
    clock_s: Array | None = None
    clock_variance: Array | None = None
    constants_covariance: Array | None = None
    modes: int = 1
    causes: tuple[Cause, ...] = ()
    innovations: tuple[Innovation, ...] = ()

    def value(self, name: str, *robots: int) -> float:
        """Return a constant of the flight by name and robots (0: observer, 1: peer)."""
        return float(self.constants[self.layout.find(name, *robots)])

    def interpolate_at(self, time_s: Array) -> tuple[Array, Array, Statuses]:
        """Interpolate positions (N, 2), covariances (N, 2, 2) and statuses (N,) at times.

        Outside the flight the nearest end is used, and the status is UNCONVERGED at best.
        """
        place = np.interp(time_s, self.time_s, np.arange(len(self.time_s)))
        low = np.clip(place.astype(int), 0, len(self.time_s) - 2)
        share = (place - low)[:, None]
        xy = self.state[low, :2] * (1 - share) + self.state[low + 1, :2] * share
        part = share[..., None]
        spread = self.covariance[low, :2, :2] * (1 - part) + self.covariance[low + 1, :2, :2] * part
        status = np.maximum(self.status[low], self.status[low + 1])
        outside = (time_s < self.time_s[0]) | (time_s > self.time_s[-1])
        return xy, spread, np.where(outside, np.maximum(status, UNCONVERGED), status)


def transform_to_peer(state: Array) -> Array:
    """Return (K, 3) the states of the observer in the peer's horizontal frame."""
    out = -state
    out[:, :2] = rotate(rotation_matrix(-state[:, 2]), out[:, :2])
    return out


def seen_from_peer(estimate: Estimate) -> Estimate:
    """Return the same flight with the peer as observer. The status stays that of the observer."""
    state = transform_to_peer(estimate.state)
    # In the peer's frame p' = -R(-psi) p and psi' = -psi. The derivative of p' by psi is -Q p',
    # with Q a quarter turn. To first order the covariance of the new state is J C J^T.
    by_state = np.zeros((len(state), 3, 3))
    by_state[:, :2, :2], by_state[:, 2, 2] = -rotation_matrix(-estimate.state[:, 2]), -1.0
    by_state[:, :2, 2] = -state[:, :2] @ QUARTER_TURN.T
    covariance = by_state @ estimate.covariance @ by_state.swapaxes(1, 2)
    return replace(
        estimate,
        state=state,
        covariance=covariance,
        constants=from_peer(estimate.layout, estimate.constants),
        constants_covariance=None,
        causes=tuple(cause.seen_from_peer() for cause in estimate.causes),
        innovations=tuple(one.seen_from_peer() for one in estimate.innovations),
        height_m=None if estimate.height_m is None else -estimate.height_m,
    )
