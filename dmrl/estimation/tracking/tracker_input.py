"""Input of the tracker: the observer's motion between two images, and its detections."""

from dataclasses import dataclass

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
    sigma_depth_m
        (N,) standard deviation of the depth, 0 where unknown. None: unknown for all.
    """

    uv: Array
    depth_m: Array
    roll_rad: float
    pitch_rad: float
    sigma_depth_m: Array | None = None
