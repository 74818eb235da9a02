"""Track peers over time from detections, with covariance and existence. Arrays only.

Every detection above a low floor counts, by its place and by its confidence; see ``association``.
The update is that of a probabilistic data association filter (Bar-Shalom, Daum and Huang 2009).
All tracks are rows of arrays of fixed layout, and a step has no loop over them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv, ndtr

from dmrl.estimation.tracking.association import Association, associate
from dmrl.estimation.tracking.detector_rates import DetectorRates
from dmrl.estimation.tracking.track_states import (
    BIAS,
    FALSE_OBJECT,
    NOBODY,
    SEEN,
    SILENT,
    P,
    TrackStates,
    cartesian_from_polar,
    start_states,
)
from dmrl.estimation.tracking.tracker_input import EgoMotion, ImageDetections
from dmrl.estimation.tracking.tuning import Tuning
from dmrl.geometry.frames import Array, Camera, horizontal_from_pixels, pixels_from_horizontal

LOG_DEPTH_SPAN = np.log(20.0)
"""Range of the log depth of false alarms, uniform from near to twenty times that. No record of how
the value was chosen."""
MAX_TRACKS = 24
"""Largest number of tracks, those not reported included; the least probable ones are dropped."""
MIN_OBJECT = 0.05
"""Probability of any object, peer or false, below which a track is deleted."""
MIN_UNEXPLAINED = 0.2
"""Least probability that a detection belongs to no track, for it to start one."""


@dataclass(frozen=True, slots=True)
class Track:
    """Track of one peer after an image.

    Parameters
    ----------
    number
        Unique number of the track.
    position_m, velocity_mps
        (3,) in the observer's horizontal frame; and over ground, along the axes of that frame.
    state_covariance
        (6, 6) of position and velocity.
    existence
        Probability that it is a peer.
    age_s, unseen_s
        Time since its first and since its last probable detection.
    """

    number: int
    position_m: Array
    velocity_mps: Array
    state_covariance: Array
    existence: float
    age_s: float
    unseen_s: float

    @property
    def covariance(self) -> Array:
        """(3, 3) of the position, m^2."""
        return np.asarray(self.state_covariance[P, P])


class Tracker:
    """Tracker of one observer, stepped image by image.

    Parameters
    ----------
    camera
        Camera of the observer; ``distortion`` is empty for undistorted images.
    tuning
        Expected errors, see `Tuning`.
    rates
        Rates of the detector. None: those of dmrl-nano.
    """

    def __init__(self, camera: Camera, tuning: Tuning, rates: DetectorRates | None = None) -> None:
        self.camera, self.tuning, self.rates = camera, tuning, rates or DetectorRates()
        self.states = TrackStates()
        self._next_number = 0
        volume = camera.width_px * camera.height_px * LOG_DEPTH_SPAN
        self._false_density = self.rates.false_per_image / volume
        self._gate = float(
            2 * gammaincinv(1.5, tuning.gate)
        )  # quantile of chi squared, 3 dimensions

    def step(self, motion: EgoMotion, view: ImageDetections) -> list[Track]:
        """Return the reported tracks after the observer has moved and taken another image.

        Parameters
        ----------
        motion
            Motion since the last image.
        view
            All detections of this image, and the attitude.
        """
        view = view.select(view.confidence >= self.rates.min_confidence)
        evidence = self.rates.log_ratio(view.confidence)
        free = np.ones(len(evidence))
        if len(self.states):
            self.states.predict(motion, self.tuning)
            self._predict_beliefs(motion.dt_s)
            free = self._update(motion.dt_s, view, evidence)
        if (free > MIN_UNEXPLAINED).any():
            self._start_tracks(motion.dt_s, view, evidence, free)
        self._report_and_delete()
        return self._build_tracks()

    def _predict_beliefs(self, dt_s: float) -> None:
        """Move the beliefs by the Markov chain of appearance, silence and end."""
        t, belief = self.tuning, self.states.belief
        stays, lasts = np.exp(-dt_s / t.leaving_s), np.exp(-dt_s / t.lasting_false_s)
        peer = self.states.existence * stays
        # The share of time seen follows from the share of images with a detection.
        detected = self.rates.detected_share(np.exp(self.states.mean[:, 2]))
        share = (detected - t.silent_share) / (t.seen_share - t.silent_share)
        mixed = 1 - np.exp(-dt_s / t.visibility_s)
        seen = belief[:, SEEN] * stays
        seen = seen + mixed * (np.clip(share, 0.02, 0.98) * peer - seen)
        false = belief[:, FALSE_OBJECT] * lasts
        self.states.belief = np.stack([1 - peer - false, false, seen, peer - seen], axis=1)

    def _predict_measurement(self, view: ImageDetections) -> tuple[Array, Array, Array]:
        """Predict u, v, log depth (T, 3), their Jacobian (T, 3, 7) and the noise but the depth's.

        A track at or behind the optical centre gets NaN.
        """
        place_m, by_polar = cartesian_from_polar(self.states.mean[:, P])
        roll, pitch = (np.full(len(place_m), a) for a in (view.roll_rad, view.pitch_rad))
        uv, depth_m, by = pixels_from_horizontal(place_m, roll, pitch, self.camera)
        by[:, 2] /= depth_m[:, None]
        row = np.zeros((len(place_m), 3, 7))
        row[:, :, P], row[:, 2, BIAS] = by[:, :, :3] @ by_polar, 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            log_depth = np.log(depth_m) + self.states.mean[:, BIAS]
        return np.hstack([uv, log_depth[:, None]]), row, self._pixel_noise(by)

    def _pixel_noise(self, by: Array) -> Array:
        """Return (T, 3, 3) noise of pixel and attitude; ``by`` (T, 3, 5) as of the projection."""
        t = self.tuning
        white = np.diag([t.pixel_std_px**2, t.pixel_std_px**2, 0.0])
        return np.asarray(
            white + t.tilt_std_rad**2 * by[:, :, 3:] @ by[:, :, 3:].transpose(0, 2, 1)
        )

    def _depth_noise(self, view: ImageDetections) -> Array:
        """Return (N, 3, 3) noise of each detection's log depth."""
        ratio = np.full(len(view.depth_m), self.tuning.depth_std_ratio)
        if view.sigma_depth_m is not None:
            known = view.sigma_depth_m > 0
            ratio[known] = view.sigma_depth_m[known] / view.depth_m[known]
        noise = np.zeros((len(ratio), 3, 3))
        noise[:, 2, 2] = ratio**2
        return noise

    def _in_view(self, mean: Array, spread: Array) -> Array:
        """Return (T,) probabilities that the network can see the tracks: in view, off the edge."""
        size = np.array([self.camera.width_px, self.camera.height_px])
        std = np.sqrt(np.diagonal(spread[:, :2, :2], axis1=1, axis2=2) + self.tuning.edge_px**2)
        inside = ndtr((size - mean[:, :2]) / std) - ndtr(-mean[:, :2] / std)
        return np.asarray(np.nan_to_num(inside.prod(axis=1)))

    def _update(self, dt_s: float, view: ImageDetections, evidence: Array) -> Array:
        """Update all tracks; return (N,) probabilities that a detection belongs to none."""
        states, t = self.states, self.tuning
        mean, row, noise = self._predict_measurement(view)
        ahead = np.asarray(np.isfinite(mean).all(axis=1))
        row[~ahead], noise[~ahead] = 0.0, np.eye(3)
        base = row @ states.covariance @ row.transpose(0, 2, 1) + noise
        spread = base[:, None] + self._depth_noise(view)
        off = np.column_stack([view.uv, np.log(view.depth_m)]) - mean[:, None]
        inverse = np.linalg.inv(spread)
        squared = (off[:, :, None] @ inverse @ off[..., None])[..., 0, 0]
        likelihood = np.exp(-0.5 * squared) / np.sqrt(np.linalg.det(2 * np.pi * spread))
        near = np.where(squared <= self._gate, likelihood / self._false_density, 0.0)
        shares = np.array([0.0, t.seen_share, t.seen_share, t.silent_share])
        found = self._in_view(mean, base)[:, None] * shares
        # Confidences of consecutive images repeat each other. As a first-order Gauss-Markov process
        # only their change is new.
        alike = np.exp(-dt_s / t.confidence_s)
        bright = np.exp((evidence - alike * states.evidence[:, None]) / (1 + alike))
        weights = associate(states.belief, found, near, bright)
        states.belief = weights.belief
        states.evidence = weights.miss * alike * states.evidence + weights.detection @ evidence
        states.unseen_s[weights.detection.sum(axis=1) > 0.5] = 0.0
        gain = states.covariance[:, None] @ row.transpose(0, 2, 1)[:, None] @ inverse
        self._merge_updates(weights, gain, np.where(ahead[:, None, None], off, 0.0), spread)
        mine = weights.detection * (1 - weights.belief[:, NOBODY, None])
        return np.asarray(1 - np.minimum(mine.sum(axis=0), 1.0))

    def _merge_updates(self, weights: Association, gain: Array, off: Array, spread: Array) -> None:
        """Replace each state by the mean and covariance of its updates by every detection."""
        states, each = self.states, weights.detection[..., None]
        moved = (gain @ off[..., None])[..., 0]
        step = (each * moved).sum(axis=1)
        apart = moved - step[:, None]
        after = states.covariance[:, None] - gain @ spread @ gain.transpose(0, 1, 3, 2)
        after = after + apart[..., None] * apart[:, :, None]
        missed = states.covariance + step[:, :, None] * step[:, None]
        states.mean = states.mean + step
        states.covariance = weights.miss[:, None, None] * missed + (each[..., None] * after).sum(1)

    def _start_tracks(
        self, dt_s: float, view: ImageDetections, evidence: Array, free: Array
    ) -> None:
        """Start a track at every detection that no track explains."""
        t, alarms = self.tuning, self.rates.false_per_image
        roll, pitch = (np.full(len(free), angle) for angle in (view.roll_rad, view.pitch_rad))
        place_m = horizontal_from_pixels(view.uv, view.depth_m, roll, pitch, self.camera)
        use = np.isfinite(place_m).all(axis=1) & (free > MIN_UNEXPLAINED)
        place_m, free = place_m[use], free[use]
        by = pixels_from_horizontal(place_m, roll[use], pitch[use], self.camera)[2]
        by[:, 2] /= view.depth_m[use, None]
        noise = self._pixel_noise(by) + self._depth_noise(view)[use]
        states = start_states(place_m, noise, by[:, :, :3], t)
        # Without a step before, as in the first image, peers have had a second to appear.
        states.belief[:, SEEN] = t.appearing_per_s * (dt_s or 1.0) * np.exp(evidence[use]) * free
        states.belief[:, FALSE_OBJECT] = alarms * t.lasting_false_share * free
        states.belief[:, NOBODY] = alarms - states.belief[:, FALSE_OBJECT]
        states.belief /= states.belief.sum(axis=1, keepdims=True)
        states.evidence = evidence[use]
        self.states = self.states.concatenate(states)

    def _report_and_delete(self) -> None:
        """Decide which tracks are reported, and delete those without an object."""
        t, states = self.tuning, self.states
        if not len(states):
            return
        existence = states.existence
        # One detection, however sure, is no track: a second one costs an image and tells a lot.
        again = (states.age_s > 0) & (states.unseen_s == 0)
        new = (existence >= t.confirm) & again & (states.number < 0)
        for k in np.flatnonzero(new):
            states.number[k] = self._continue_track(int(k))
        states.reported &= existence >= t.keep
        states.reported |= (existence >= t.confirm) & (states.number >= 0)
        existence = states.existence
        spread = states.cartesian()[1][:, P, P]
        std_m = np.sqrt(np.linalg.eigvalsh(spread)[:, -1])
        kept = (1 - states.belief[:, NOBODY] >= MIN_OBJECT) & (std_m < t.lost_std_m)
        rows = np.flatnonzero(kept)
        best = rows[np.argsort(-existence[rows], kind="stable")][:MAX_TRACKS]
        self.states = states.select(np.sort(best))

    def _continue_track(self, k: int) -> int:
        """Return the number of a new track: a fresh one, or that of the track that it continues.

        A silent track ends where a new one starts inside its gate: both are of the same peer.
        """
        states = self.states
        silent = np.flatnonzero(states.reported & (states.unseen_s >= states.age_s[k]))
        mean, covariance = (part[:, ..., :3] for part in states.cartesian())
        off = mean[silent] - mean[k]
        spread = covariance[silent, :3] + covariance[k, :3]
        squared = (off[:, None] @ np.linalg.inv(spread) @ off[..., None])[:, 0, 0]
        if len(silent) and squared.min() < self._gate:
            old = silent[squared.argmin()]
            states.belief[old], states.reported[old] = np.eye(4)[NOBODY], False
            return int(states.number[old])
        self._next_number += 1
        return self._next_number - 1

    def _build_tracks(self) -> list[Track]:
        """Return the reported tracks.

        A lasting tilt turns all positions alike, so images never reduce it. It is added here. So is
        the error of a silent track that follows a false object.
        """
        states = self.states.select(np.flatnonzero(self.states.reported))
        mean, covariance = states.cartesian()
        x, y, z = mean[:, P].T
        zero = np.zeros(len(x))
        tilt = self.tuning.tilt_bias_rad * np.stack([zero, z, -z, zero, y, -x], 1).reshape(-1, 3, 2)
        covariance[:, P, P] += tilt @ tilt.transpose(0, 2, 1)
        silent = states.belief[:, SILENT] / states.existence
        covariance[:, P, P] += self.tuning.capture_std_m**2 * silent[:, None, None] * np.eye(3)
        columns = (states.number, states.existence, states.age_s, states.unseen_s)
        return [
            Track(number, row[:3], row[3:], square, *rest)
            for row, square, (number, *rest) in zip(
                mean, covariance, zip(*(c.tolist() for c in columns), strict=True), strict=True
            )
        ]
