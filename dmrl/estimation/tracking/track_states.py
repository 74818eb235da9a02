"""States of all tracks of an observer as arrays, and their prediction from image to image.

A position is kept as azimuth, elevation and log range (modified polar coordinates, Aidala and
Hammel 1983). In Cartesian coordinates a filter with precise bearings and coarse depths takes its
own linearisation error for knowledge of the range.
"""

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.tracking.tracker_input import EgoMotion
from dmrl.estimation.tracking.tuning import Tuning
from dmrl.geometry.frames import Array

P, V, BIAS = slice(0, 3), slice(3, 6), 6
"""Indices of position, velocity and depth error in the state."""
NOBODY, FALSE_OBJECT, SEEN, SILENT = range(4)
"""Hypotheses on a track: a single false alarm; a false object that stays at its place; a peer that
the network sees; a peer in a stretch of silence."""
MIN_RANGE_M = 0.05
"""Smallest range, metres. A peer at the observer's own place has no bearing."""


@dataclass(slots=True)
class TrackStates:
    """All tracks of an observer, one row each, and an empty set of tracks by default.

    Parameters
    ----------
    mean, covariance
        (T, 7) and (T, 7, 7). Azimuth and elevation (rad) and log of the range (m) in the horizontal
        frame, velocity over ground along its axes (m/s), relative depth error.
    belief
        (T, 4) probabilities of the hypotheses `NOBODY`, `FALSE_OBJECT`, `SEEN` and `SILENT`.
    evidence
        (T,) log likelihood ratio of the last confidence, decayed.
    age_s, unseen_s
        (T,) time since the first and since the last probable detection.
    number
        (T,) unique number, -1 before the first report.
    reported
        (T,) whether the track is reported.
    """

    mean: Array = field(default_factory=lambda: np.zeros((0, 7)))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 7, 7)))
    belief: Array = field(default_factory=lambda: np.zeros((0, 4)))
    evidence: Array = field(default_factory=lambda: np.zeros(0))
    age_s: Array = field(default_factory=lambda: np.zeros(0))
    unseen_s: Array = field(default_factory=lambda: np.zeros(0))
    number: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    reported: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def existence(self) -> Array:
        """(T,) probability that the track is a peer."""
        return np.asarray(self.belief[:, SEEN] + self.belief[:, SILENT])

    def select(self, rows: NDArray[np.int64]) -> "TrackStates":
        """Return some tracks."""
        return TrackStates(*(getattr(self, f.name)[rows] for f in fields(self)))

    def concatenate(self, other: "TrackStates") -> "TrackStates":
        """Return these tracks and others after them."""
        names = [f.name for f in fields(self)]
        pairs = ((getattr(self, name), getattr(other, name)) for name in names)
        return TrackStates(*(np.concatenate(pair) for pair in pairs))

    def cartesian(self) -> tuple[Array, Array]:
        """Return (T, 6) positions and velocities, and their (T, 6, 6) covariances."""
        place_m, by_polar = cartesian_from_polar(self.mean[:, P])
        by_state = np.zeros((len(self), 6, 6))
        by_state[:, P, P], by_state[:, V, V] = by_polar, np.eye(3)
        covariance = by_state @ self.covariance[:, :6, :6] @ by_state.transpose(0, 2, 1)
        return np.hstack([place_m, self.mean[:, V]]), covariance

    def predict(self, motion: EgoMotion, tuning: Tuning) -> None:
        """Predict the states in a frame that moves and turns.

        A peer's velocity is a first-order Gauss-Markov process (Singer's idea, one order lower):
        robots reverse, so a constant velocity would carry an unseen peer away.
        """
        dt = motion.dt_s
        self.age_s += dt
        self.unseen_s += dt
        c, s = np.cos(motion.turn_rad), np.sin(motion.turn_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # new from old axes
        keep, calm = np.exp(-dt / tuning.depth_bias_s), np.exp(-dt / tuning.velocity_s)
        reach_s = tuning.velocity_s * (1 - calm)
        before_m, by_polar = cartesian_from_polar(self.mean[:, P])
        velocity = self.mean[:, V] @ turn.T
        place_m: Array = (before_m - motion.shift_m) @ turn.T + reach_s * velocity
        polar = _polar_from_cartesian(place_m)
        back = np.asarray(np.linalg.inv(cartesian_from_polar(polar)[1]), float)
        move = np.zeros((len(self), 7, 7))
        move[:, P, P], move[:, P, V] = back @ turn @ by_polar, back @ (reach_s * turn)
        move[:, V, V], move[:, BIAS, BIAS] = calm * turn, keep
        self.mean = np.hstack([polar, calm * velocity, keep * self.mean[:, BIAS:]])
        noise = _process_noise(place_m, back, dt, tuning)
        self.covariance = move @ self.covariance @ move.transpose(0, 2, 1) + noise


def _process_noise(place_m: Array, back: Array, dt_s: float, tuning: Tuning) -> Array:
    """Return (T, 7, 7) process noise; ``back`` is (T, 3, 3) of polar by Cartesian coordinates."""
    t, tau = tuning, tuning.velocity_s
    keep, calm = np.exp(-dt_s / t.depth_bias_s), np.exp(-dt_s / tau)
    power = np.diag([t.speed_std_mps, t.speed_std_mps, t.climb_std_mps]) ** 2
    # The integral of a Gauss-Markov velocity over the step.
    moved = power * tau**2 * (2 * dt_s / tau - 3 + 4 * calm - calm**2)
    drift = np.diag([t.own_drift_m**2 * dt_s] * 2 + [t.own_height_std_m**2])
    # A wrong heading moves a peer sideways, in proportion to its distance.
    across = np.stack([place_m[:, 1], -place_m[:, 0], np.zeros(len(place_m))], axis=1)
    heading = t.yaw_drift_rad**2 * dt_s * across[:, :, None] * across[:, None]
    noise = np.zeros((len(place_m), 7, 7))
    noise[:, P, P] = back @ (moved + drift + heading) @ back.transpose(0, 2, 1)
    noise[:, P, V] = back @ (power * tau * (1 - calm) ** 2)
    noise[:, V, P] = noise[:, P, V].transpose(0, 2, 1)
    noise[:, V, V] = power * (1 - calm**2)
    noise[:, BIAS, BIAS] = t.depth_bias_ratio**2 * (1 - keep**2)
    return noise


def cartesian_from_polar(polar: Array) -> tuple[Array, Array]:
    """Return (T, 3) positions, m, and their (T, 3, 3) derivatives by azimuth, elevation, log range.

    Parameters
    ----------
    polar
        (T, 3) azimuth and elevation, rad, and log of the range, m.
    """
    azimuth, elevation, log_range = polar.T
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    r = np.exp(log_range)
    flat, up = r * ce, r * se
    place_m, by_polar = np.empty((len(polar), 3)), np.zeros((len(polar), 3, 3))
    place_m[:, 0], place_m[:, 1], place_m[:, 2] = flat * ca, flat * sa, up
    by_polar[:, 0, 0], by_polar[:, 1, 0] = -place_m[:, 1], place_m[:, 0]
    by_polar[:, 0, 1], by_polar[:, 1, 1], by_polar[:, 2, 1] = -up * ca, -up * sa, flat
    by_polar[:, :, 2] = place_m
    return place_m, by_polar


def _polar_from_cartesian(place_m: Array) -> Array:
    """Return (T, 3) azimuth, elevation and log range; never straight above or below."""
    r = np.maximum(np.linalg.norm(place_m, axis=1), MIN_RANGE_M)
    azimuth = np.arctan2(place_m[:, 1], place_m[:, 0])
    elevation = np.arcsin(np.clip(place_m[:, 2] / r, -0.999, 0.999))
    return np.stack([azimuth, elevation, np.log(r)], axis=1)


def start_states(place_m: Array, noise: Array, by_place: Array, tuning: Tuning) -> TrackStates:
    """Return the states of new tracks, without beliefs.

    Parameters
    ----------
    place_m
        (T, 3) positions of the detections.
    noise
        (T, 3, 3) noise of their pixel and log depth, the lasting depth error left out.
    by_place
        (T, 3, 3) derivative of pixel and log depth by the position.
    tuning
        Expected errors.
    """
    t, count = tuning, len(place_m)
    polar = _polar_from_cartesian(place_m)
    by_polar = by_place @ cartesian_from_polar(polar)[1]
    # The position inverts the measurement model: position = inverse of (measurement - bias). So it
    # contains the noise of the pixels, and the bias with the opposite sign.
    back, bias = np.linalg.inv(by_polar), t.depth_bias_ratio**2
    covariance = np.zeros((count, 7, 7))
    covariance[:, P, P] = back @ (noise + np.diag([0.0, 0.0, bias])) @ back.transpose(0, 2, 1)
    covariance[:, P, BIAS] = covariance[:, BIAS, P] = -back[:, :, 2] * bias
    covariance[:, V, V] = np.diag([t.speed_std_mps, t.speed_std_mps, t.climb_std_mps]) ** 2
    covariance[:, BIAS, BIAS] = bias
    zero = np.zeros(count)
    return TrackStates(
        np.hstack([polar, np.zeros((count, 4))]),
        covariance,
        np.zeros((count, 4)),
        zero,
        zero.copy(),
        zero.copy(),
        np.full(count, -1),
        np.zeros(count, bool),
    )
