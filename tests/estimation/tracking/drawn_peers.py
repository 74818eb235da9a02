"""Simulated peers and a detector that match the tracker's tuning."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dmrl.estimation.tracking.detector_rates import DetectorRates
from dmrl.estimation.tracking.tracker import Tracker
from dmrl.estimation.tracking.tracker_input import EgoMotion, ImageDetections
from dmrl.estimation.tracking.tuning import Tuning
from dmrl.geometry.frames import (
    AIDECK,
    Array,
    horizontal_from_pixels,
    is_inside,
    pixels_from_horizontal,
)

TUNING = Tuning()
DT_S = 0.1


@dataclass(frozen=True)
class Detector:
    """A simulated network with the noise of the tuning, misses and false alarms.

    The logits of true and false detections are normal with unit variance and means of 1 and -1.
    So the log likelihood ratio of a logit is 2 logit, as in `CALIBRATED`.
    """

    rng: np.random.Generator
    share: float = 0.7
    false_per_image: float = 0.3

    def view(self, peers: Array, bias: Array) -> ImageDetections:
        uv, depth_m, _ = pixels_from_horizontal(
            peers, np.zeros(len(peers)), np.zeros(len(peers)), AIDECK
        )
        seen = is_inside(uv, 320, 224) & (depth_m > 0) & (self.rng.random(len(peers)) < self.share)
        noise = self.rng.normal(size=(len(peers), 3))
        tilt_px = TUNING.tilt_std_rad * AIDECK.fx_px * self.rng.normal(size=2)
        uv = uv + TUNING.pixel_std_px * noise[:, :2] + tilt_px
        depth_m = depth_m * np.exp(TUNING.depth_std_ratio * noise[:, 2] + bias)
        alarms = self.rng.poisson(self.false_per_image)
        false_uv = self.rng.uniform((0, 0), (320, 224), (alarms, 2))
        false_m = 0.3 * np.exp(self.rng.uniform(0, np.log(20), alarms))
        logit = self.rng.normal(size=seen.sum() + alarms)
        logit += np.repeat([1.0, -1.0], [seen.sum(), alarms])
        return ImageDetections(
            np.concatenate([uv[seen], false_uv]),
            np.concatenate([depth_m[seen], false_m]),
            0.0,
            0.0,
            1 / (1 + np.exp(-logit)),
        )


CALIBRATED = DetectorRates(0.0, (1.0,), (0.7,), 0.3, 2.0, 0.0)


def simulate_path(rng: np.random.Generator, steps: int, start: Array) -> Iterator[Array]:
    """Yield positions (3,) of a peer with the velocity model of the tuning, metres."""
    place, std = start.copy(), np.array([TUNING.speed_std_mps] * 2 + [TUNING.climb_std_mps])
    speed, fine = std * rng.normal(size=3), DT_S / 10
    calm = np.exp(-fine / TUNING.velocity_s)
    for _ in range(steps):
        for _ in range(10):
            place = place + fine * speed
            speed = calm * speed + np.sqrt(1 - calm**2) * std * rng.normal(size=3)
        place = place + 1.0 * DT_S * (start - place)  # pull it back, so that it stays in view
        yield place


def simulate_depth_biases(rng: np.random.Generator, steps: int, peers: int) -> Iterator[Array]:
    """Yield correlated relative depth errors (peers,)."""
    keep = np.exp(-DT_S / TUNING.depth_bias_s)
    bias = rng.normal(size=peers)
    for _ in range(steps):
        yield TUNING.depth_bias_ratio * bias
        bias = keep * bias + np.sqrt(1 - keep**2) * rng.normal(size=peers)


@dataclass
class Outcome:
    """Result of a run: squared errors of tracks and of single detections, and track numbers."""

    squared: list[float]
    track_m2: list[float]
    single_m2: list[float]
    ids: list[int]
    false_tracks: int


def run_tracker(seed: int, starts: Array, steps: int = 600) -> Outcome:
    """Track simulated peers that start at (K, 3) positions, and compare with the truth."""
    rng = np.random.default_rng(seed)
    tracker, detector = Tracker(AIDECK, TUNING, CALIBRATED), Detector(rng)
    paths = [simulate_path(rng, steps, start) for start in starts]
    out = Outcome([], [], [], [], 0)
    false: set[int] = set()
    for biases in simulate_depth_biases(rng, steps, len(starts)):
        truth = np.array([next(path) for path in paths])
        view = detector.view(truth, biases)
        tracks = tracker.step(EgoMotion(DT_S, np.zeros(3), 0.0), view)
        level = np.zeros(len(view.uv))
        single = horizontal_from_pixels(view.uv, view.depth_m, level, level, AIDECK)
        for track in tracks:
            apart = np.linalg.norm(track.position_m - truth, axis=1)
            if apart.min() > 1.0:
                false.add(track.number)
                continue
            error = track.position_m - truth[apart.argmin()]
            out.squared.append(error @ np.linalg.inv(track.covariance) @ error)
            nearest = np.linalg.norm(single - truth[apart.argmin()], axis=1).min(initial=np.inf)
            if nearest < 1.0:
                out.track_m2.append(float(error @ error))
                out.single_m2.append(float(nearest**2))
            out.ids.append(track.number)
    out.false_tracks = len(false)
    return out
