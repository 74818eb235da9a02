"""Track peers over time from detections, with covariance. Arrays only.

One extended Kalman filter (filterpy's) runs per track. Its state is the position of the peer and
its velocity over ground, both along the axes of the observer's horizontal frame, and the relative
depth error of the network for this peer. The depth error lasts for seconds, since the image hardly
changes. As white noise it would make every covariance too small.

Birth, confirmation and death follow the score of a track: the log likelihood ratio of its
detections between a peer and false alarms (Blackman and Popoli 1999, 6.2).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from dmrl.estimation.tracking.tracker_input import EgoMotion, ImageDetections
from dmrl.estimation.tracking.tuning import Tuning
from dmrl.geometry.frames import (
    Array,
    Camera,
    horizontal_from_pixels,
    is_inside,
    pixels_from_horizontal,
)

P, V, BIAS = slice(0, 3), slice(3, 6), 6
"""Index of position, velocity and depth error in the state."""
LOG_DEPTH_SPAN = np.log(20.0)
"""Range of the log depth of false alarms, uniform from near to twenty times that. No record of how
the value was chosen."""


class _Filter(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """Extended Kalman filter of filterpy with a linear prediction.

    The input is the observer's shift.
    """

    def __init__(self, state: Array, covariance: Array) -> None:
        super().__init__(dim_x=7, dim_z=3)
        self.x, self.P = state, covariance

    def predict_x(self, u: Array) -> None:
        """Move the state; filterpy's ``predict`` then moves the covariance by F and Q."""
        self.x = self.F @ self.x + u


@dataclass(slots=True)
class Track:
    """Track of one peer.

    Parameters
    ----------
    number
        Unique number of the track.
    filter
        State and covariance.
    score, best
        Log odds that it is a peer, now and at their highest.
    confirmed
        Whether the odds were ever high enough.
    """

    number: int
    filter: _Filter
    score: float = 0.0
    best: float = field(default=-np.inf)
    confirmed: bool = False

    @property
    def position_m(self) -> Array:
        """(3,) in the observer's horizontal frame."""
        return np.asarray(self.filter.x[P])

    @property
    def velocity_mps(self) -> Array:
        """(3,) over ground, along the axes of that frame."""
        return np.asarray(self.filter.x[V])

    @property
    def covariance(self) -> Array:
        """(3, 3) of the position, m^2."""
        return np.asarray(self.filter.P[P, P])


class Tracker:
    """Tracker of one observer.

    Parameters
    ----------
    camera
        Camera of the observer; ``distortion`` is empty for undistorted images.
    tuning
        Expected errors, see `Tuning`.
    """

    def __init__(self, camera: Camera, tuning: Tuning) -> None:
        self.camera, self.tuning = camera, tuning
        self.tracks: list[Track] = []
        self._born = 0
        area = camera.width_px * camera.height_px * LOG_DEPTH_SPAN
        self._false_density = tuning.false_per_image / area
        self._gate = float(chi2.ppf(tuning.gate, 3))

    def step(self, motion: EgoMotion, view: ImageDetections) -> list[Track]:
        """Return the confirmed tracks after the observer has moved and taken another image.

        Parameters
        ----------
        motion
            Motion since the last image.
        view
            Detections of this image, and the attitude.
        """
        for track in self.tracks:
            self._predict(track, motion)
        free = self._associate(view)
        self._delete_lost()
        self._start_tracks(view, free)
        return [track for track in self.tracks if track.confirmed]

    def _predict(self, track: Track, motion: EgoMotion) -> None:
        """Predict with constant velocity over ground, in a frame that moves and turns."""
        t, dt = self.tuning, motion.dt_s
        c, s = np.cos(motion.turn_rad), np.sin(motion.turn_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])  # new from old axes
        # The depth error is a first-order Gauss-Markov process: it decays with ``depth_bias_s``,
        # and the noise below compensates for that, so that its variance stays constant.
        keep = np.exp(-dt / t.depth_bias_s)
        ekf = track.filter
        ekf.F = np.zeros((7, 7))
        ekf.F[P, P], ekf.F[P, V], ekf.F[V, V], ekf.F[BIAS, BIAS] = turn, dt * turn, turn, keep
        x, y, _ = ekf.x[P]
        # A wrong yaw rate moves the peer sideways, in proportion to its distance.
        across = np.array([y, -x, 0.0]) * t.yaw_rate_std_radps * dt
        own = (t.own_velocity_std_mps * dt) ** 2 * np.diag([1.0, 1.0, 0.0])
        power = t.acceleration_std_mps2**2 * np.eye(3)
        # White noise of acceleration, integrated over dt (Bar-Shalom et al. 2001, 6.2).
        ekf.Q = np.zeros((7, 7))
        ekf.Q[P, P] = power * dt**3 / 3 + own + np.outer(across, across)
        ekf.Q[P, V] = ekf.Q[V, P] = power * dt**2 / 2
        ekf.Q[V, V] = power * dt
        ekf.Q[BIAS, BIAS] = t.depth_bias_ratio**2 * (1 - keep**2)
        shift = np.zeros(7)
        shift[P] = -turn @ motion.shift_m
        ekf.predict(shift)

    def _predict_measurement(
        self, track: Track, view: ImageDetections
    ) -> tuple[Array, Array, Array]:
        """Predict u, v, log depth (3,), their Jacobian (3, 7) and the noise except the depth's."""
        t = self.tuning
        attitude = np.array([view.roll_rad]), np.array([view.pitch_rad])
        uv, depth_m, by = pixels_from_horizontal(track.position_m[None], *attitude, self.camera)
        # The logarithm, because the error of a depth grows with it. Its derivative is 1 / depth.
        by = by[0] / np.array([[1.0], [1.0], [depth_m[0]]])
        row = np.zeros((3, 7))
        row[:, P], row[2, BIAS] = by[:, :3], 1.0
        white = np.diag([t.pixel_std_px**2, t.pixel_std_px**2, 0.0])
        noise = white + t.attitude_std_rad**2 * by[:, 3:] @ by[:, 3:].T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.array([*uv[0], np.log(depth_m[0]) + track.filter.x[BIAS]]), row, noise

    def _depth_noise(self, view: ImageDetections) -> Array:
        """Return (N, 3, 3) noise of each detection's log depth."""
        ratio = np.full(len(view.depth_m), self.tuning.depth_std_ratio)
        if view.sigma_depth_m is not None:
            known = view.sigma_depth_m > 0
            ratio[known] = view.sigma_depth_m[known] / view.depth_m[known]
        noise = np.zeros((len(ratio), 3, 3))
        noise[:, 2, 2] = ratio**2
        return noise

    def _associate(self, view: ImageDetections) -> list[int]:
        """Update every track with its best detection; return the detections without a track."""
        seen = np.column_stack([view.uv, np.log(view.depth_m)])
        of_depth = self._depth_noise(view)
        expected = [self._predict_measurement(track, view) for track in self.tracks]
        gain = np.full((len(self.tracks), len(seen)), -np.inf)
        for k, (track, (mean, row, noise)) in enumerate(zip(self.tracks, expected, strict=True)):
            if np.isfinite(mean).all():
                spread = row @ track.filter.P @ row.T + noise + of_depth
                gain[k] = self._log_likelihood_ratios(seen - mean, spread)
        free = set(range(len(seen)))
        # The solver rejects rows without any finite entry, so "never" is a large loss here.
        rows, columns = linear_sum_assignment(np.maximum(gain, -1e6), maximize=True)
        taken = {k: j for k, j in zip(rows, columns, strict=True) if np.isfinite(gain[k, j])}
        for k, track in enumerate(self.tracks):
            mean, row, noise = expected[k]
            if k in taken:
                free.discard(taken[k])
                self._update(track, seen[taken[k]], mean, row, noise + of_depth[taken[k]])
                track.score += gain[k, taken[k]]
            # A missed detection counts only if the peer is in view.
            elif np.isfinite(mean).all() and self._in_view(mean):
                track.score += np.log1p(-self.tuning.detection_share)
        return sorted(free)

    def _log_likelihood_ratios(self, difference: Array, spread: Array) -> Array:
        """Return (N,) log likelihood ratios of detections and a track; -inf outside its gate."""
        squared = np.einsum("ni,nij,nj->n", difference, np.linalg.inv(spread), difference)
        density = -0.5 * (squared + np.linalg.slogdet(2 * np.pi * spread)[1])
        ratio = np.log(self.tuning.detection_share / self._false_density) + density
        return np.where(squared <= self._gate, ratio, -np.inf)

    def _in_view(self, mean: Array) -> bool:
        return bool(is_inside(mean[None, :2], self.camera.width_px, self.camera.height_px)[0])

    def _update(self, track: Track, seen: Array, mean: Array, row: Array, noise: Array) -> None:
        track.filter.update(seen, lambda _: row, lambda _: mean, R=noise)
        assert track.filter.x.shape == (7,), "filterpy changed the state's shape"

    def _delete_lost(self) -> None:
        """Confirm tracks, and delete those whose peers are gone."""
        allowed = np.log(self.tuning.lost_odds)
        kept = []
        for track in self.tracks:
            track.best = max(track.best, track.score)
            track.confirmed |= track.score >= np.log(self.tuning.confirm_odds)
            spread_m = np.sqrt(np.linalg.eigvalsh(track.covariance)[-1])
            # A new track may lose no more than its first score.
            lost = track.best - track.score > (allowed if track.confirmed else track.best)
            if not lost and spread_m < self.tuning.lost_std_m:
                kept.append(track)
        self.tracks = kept

    def _start_tracks(self, view: ImageDetections, free: Sequence[int]) -> None:
        """Start a track at every detection without one."""
        t = self.tuning
        attitude = np.array([view.roll_rad]), np.array([view.pitch_rad])
        of_depth = self._depth_noise(view)
        for k in free:
            at = view.uv[k : k + 1], view.depth_m[k : k + 1]
            xyz = horizontal_from_pixels(*at, *attitude, self.camera)[0]
            if not np.isfinite(xyz).all():
                continue
            ekf = _Filter(np.array([*xyz, 0.0, 0.0, 0.0, 0.0]), np.zeros((7, 7)))
            ekf.P[V, V] = t.speed_std_mps**2 * np.eye(3)
            ekf.P[BIAS, BIAS] = t.depth_bias_ratio**2
            track = Track(self._born, ekf)
            _, row, noise = self._predict_measurement(track, view)
            noise += of_depth[k]
            noise[2, 2] += t.depth_bias_ratio**2
            # The first position inverts the measurement model: position = inverse of (seen - bias).
            # So it contains the noise of the pixels, and the bias with the opposite sign.
            by_pixel = np.linalg.inv(row[:, P])
            ekf.P[P, P] = by_pixel @ noise @ by_pixel.T
            ekf.P[P, BIAS] = ekf.P[BIAS, P] = -by_pixel[:, 2] * t.depth_bias_ratio**2
            self._born += 1
            self.tracks.append(track)
