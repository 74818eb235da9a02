"""Eyes of a pilot: detections of an ideal camera, or those of a network."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dmrl.deploy.detector import Detector
from dmrl.deploy.image_detection import DetectionOptions, detect_images
from dmrl.geometry.frames import AIDECK_PINHOLE, is_inside, project
from dmrl.images.codec import Rgb
from dmrl.prediction import detection_fields, grid_fields
from dmrl.rendering.onboard_camera import CameraView
from dmrl.simulation.settings import Vision

IDEAL_CONFIDENCE, IDEAL_THRESHOLD = 0.99, 0.5
IDEAL_RNG = 1000
"""Stream of the ideal eye's random numbers: the robot's number is added, renderers have less."""


@dataclass(frozen=True, slots=True)
class Look:
    """Detections of one image: the fields of Detections, and those of a GridMap or None."""

    detections: dict[str, Any]
    grid: dict[str, Any] | None = None


class Eye(Protocol):
    """Function that finds peers in the images of one robot, in their order."""

    def __call__(self, view: CameraView, time_s: float, rgb: Rgb | None) -> Look:
        """Return the detections in the image of a view, taken at a true time in seconds."""


class IdealEye:
    """Eye that detects every peer in the image, except for misses, with white errors.

    Parameters
    ----------
    vision
        Errors and misses.
    seed
        Seed of the flight.
    number
        Number of the robot.
    """

    def __init__(self, vision: Vision, seed: int, number: int) -> None:
        self._vision = vision
        self._rng = np.random.default_rng((seed, IDEAL_RNG + number))
        self._bursts = np.random.default_rng((seed, IDEAL_RNG + number, 1))
        self._blind, self._until_s = True, 0.0

    def __call__(self, view: CameraView, time_s: float, rgb: Rgb | None = None) -> Look:
        """Return the detections of a view."""
        vision, camera = self._vision, AIDECK_PINHOLE
        silent = self._is_silent(time_s)
        xyz = np.array([pose.xyz_camera for pose in view.poses.values()]).reshape(-1, 3)
        uv_px, depth_m = project(xyz, camera.image_from_optical)
        errors = self._rng.normal(size=(len(xyz), 3))
        missed = self._rng.random(len(xyz)) < (0.0 if vision.miss_burst_s else vision.miss_share)
        inside = is_inside(uv_px, camera.width_px, camera.height_px)
        found = []
        for k in np.flatnonzero(inside & ~missed & (not silent)).tolist():
            u_px, v_px = (uv_px[k] + vision.pixel_std_px * errors[k, :2]).tolist()
            depth = float(depth_m[k] * np.exp(vision.depth_std_ratio * errors[k, 2]))
            found.append(
                {
                    "u_px": u_px,
                    "v_px": v_px,
                    "depth_m": depth,
                    "confidence": IDEAL_CONFIDENCE,
                    "sigma_depth_m": vision.depth_std_ratio * depth,
                }
            )
        return Look({"detections": found, "threshold": IDEAL_THRESHOLD})

    def _is_silent(self, time_s: float) -> bool:
        """Return whether it is blind now; sight and blindness last exponential times in turn."""
        share, burst_s = self._vision.miss_share, self._vision.miss_burst_s
        if not share or not burst_s:
            return False
        while time_s >= self._until_s:
            self._blind = not self._blind
            mean_s = burst_s if self._blind else burst_s * (1 - share) / share
            self._until_s += float(self._bursts.exponential(mean_s))
        return self._blind


class NetworkEye:
    """Eye that runs a network on every image; if it magnifies, on the middle of every second one.

    A follower has its leader near the middle of the image. There the network detects it at
    distances at which it is too small in the whole image; and few false detections are in both.

    Parameters
    ----------
    detector
        The opened model.
    options
        Limits on the detections, and whether it magnifies.
    rates
        Rates of the model; None: unknown.
    """

    def __init__(
        self, detector: Detector, options: DetectionOptions, rates: dict[str, Any] | None
    ) -> None:
        self._detector, self._options, self._rates = detector, options, rates
        self._images = 0

    def __call__(self, view: CameraView, time_s: float, rgb: Rgb | None) -> Look:
        """Return the detections in an image, and the grids."""
        assert rgb is not None, "a network needs images"
        magnified = self._options.magnify and self._images % 2 == 1
        self._images += 1
        found, grids = next(detect_images([rgb], self._detector, self._options, [magnified]))
        return Look(
            detection_fields(found, 0, self._detector.threshold, self._rates),
            grid_fields(grids, 0, self._detector.stride_px),
        )
