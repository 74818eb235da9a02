"""Where a leader may be while it is not detected: a particle filter over the floor.

Images without a detection count too: the leader is less likely to be where the camera looked
(Bourgault et al. 2003, "Coordinated decentralized search for a lost target in a Bayesian world").
"""

import numpy as np

from dmrl.flight.pilot import Observation
from dmrl.geometry.frames import Array

PARTICLES = 200
SPEED_STD_MPS, SPEED_S = 0.35, 2.0
"""Standard deviation of a leader's velocity along each axis, and the time for which it lasts: those
of a leader that flies at 0.5 m/s and turns around in a few seconds."""
SIGHT_STD_MPS = 0.2
"""Error of the track's velocity at the last sight."""
VIEW_RAD = 0.6
"""Half the horizontal angle in which a peer is wholly in the image of the AI-deck's camera."""
MISS = 0.85
"""Likelihood of an image without a detection if the leader is in view, over that if it is not.
Misses last: ten images without a detection halve the odds more than three times, not a hundred."""


class LeaderBelief:
    """Weighted positions and velocities of the leader, in the robot's horizontal frame now.

    Parameters
    ----------
    place_m, velocity_mps
        (2,) mean position and velocity.
    covariance
        (2, 2) of the position, m^2.
    """

    def __init__(self, place_m: Array, velocity_mps: Array, covariance: Array) -> None:
        self._rng = np.random.default_rng(0)
        draws = self._rng.normal(size=(2, PARTICLES, 2))
        self.place_m = place_m + draws[0] @ np.linalg.cholesky(covariance + 1e-6 * np.eye(2)).T
        self.velocity_mps = velocity_mps + SIGHT_STD_MPS * draws[1]
        self.weight = np.full(PARTICLES, 1.0 / PARTICLES)

    def move(self, seen: Observation, dt_s: float) -> None:
        """Predict, after the robot has moved and turned for a while."""
        keep = np.exp(-dt_s / SPEED_S)
        kick = self._rng.normal(0.0, SPEED_STD_MPS * np.sqrt(1 - keep**2), (PARTICLES, 2))
        self.velocity_mps = keep * self.velocity_mps + kick
        self.place_m += (self.velocity_mps - seen.velocity_mps) * dt_s
        c, s = np.cos(seen.yaw_rate_radps * dt_s), np.sin(seen.yaw_rate_radps * dt_s)
        old_from_new = np.array([[c, -s], [s, c]])
        self.place_m = self.place_m @ old_from_new
        self.velocity_mps = self.velocity_mps @ old_from_new

    def miss(self) -> None:
        """Use an image without a detection."""
        self.weight[np.abs(self.bearing_rad) < VIEW_RAD] *= MISS
        self.weight /= self.weight.sum()
        if 1.0 / (self.weight @ self.weight) < PARTICLES / 2:
            steps = (np.arange(PARTICLES) + 0.5) / PARTICLES
            kept = np.searchsorted(np.cumsum(self.weight), steps).clip(max=PARTICLES - 1)
            self.place_m, self.velocity_mps = self.place_m[kept], self.velocity_mps[kept]
            self.weight[:] = 1.0 / PARTICLES

    @property
    def bearing_rad(self) -> Array:
        """(N,) angles to the left of the robot's axis."""
        return np.asarray(np.arctan2(self.place_m[:, 1], self.place_m[:, 0]))

    def mean(self) -> tuple[Array, Array, float]:
        """Return (2,) position and velocity, and the standard deviation of the position."""
        place, velocity = self.weight @ self.place_m, self.weight @ self.velocity_mps
        spread = self.weight @ ((self.place_m - place) ** 2).sum(axis=1)
        return place, velocity, float(np.sqrt(spread / 2))

    def best_bearing(self) -> float:
        """Return the direction to look in: most of the belief is in view there."""
        aims = np.linspace(-np.pi, np.pi, 33)
        away = np.abs((self.bearing_rad - aims[:, None] + np.pi) % (2 * np.pi) - np.pi)
        # A direction to turn far for is seen later, when the leader has moved on.
        gain = np.clip(1.5 - away / VIEW_RAD, 0.0, 1.0) @ self.weight - 0.05 * np.abs(aims)
        return float(aims[gain.argmax()])
