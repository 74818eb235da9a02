"""Input of the tracker: the observer's motion between two images, and its detections."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array


@dataclass(frozen=True, slots=True)
class EgoMotion:
    """Motion of the observer between two images.

    Parameters
    ----------
    dt_s
        Seconds.
    shift_m
        (3,) motion over ground, along the axes of its horizontal frame before.
    turn_rad
        Turn, positive to the left.
    """

    dt_s: float
    shift_m: Array
    turn_rad: float


@dataclass(frozen=True, slots=True)
class ImageDetections:
    """Detections of one image, and the attitude of the observer.

    Parameters
    ----------
    uv
        (N, 2) pixels.
    depth_m
        (N,) metres.
    roll_rad, pitch_rad
        Attitude of the observer.
    confidence
        (N,) confidences of the detections, 0 to 1.
    sigma_depth_m
        (N,) standard deviation of the depth, 0 where unknown. None: unknown for all.
    """

    uv: Array
    depth_m: Array
    roll_rad: float
    pitch_rad: float
    confidence: Array
    sigma_depth_m: Array | None = None

    def select(self, kept: NDArray[np.bool_]) -> "ImageDetections":
        """Return the detections of a mask (N,)."""
        sigma_m = None if self.sigma_depth_m is None else self.sigma_depth_m[kept]
        return replace(
            self,
            uv=self.uv[kept],
            depth_m=self.depth_m[kept],
            confidence=self.confidence[kept],
            sigma_depth_m=sigma_m,
        )
