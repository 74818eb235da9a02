"""The tracker's input: an observer's motion between two images, and its detections."""

from dataclasses import dataclass

from dmrl.geometry.frames import Array


@dataclass(frozen=True, slots=True)
class Motion:
    """What the observer did between two images.

    Parameters
    ----------
    dt_s
        Seconds.
    shift_m
        (3,) how far it moved over ground, along the axes of its horizontal frame before.
    turn_rad
        How far it turned, positive to the left.
    """

    dt_s: float
    shift_m: Array
    turn_rad: float


@dataclass(frozen=True, slots=True)
class View:
    """One image's detections and the attitude they were taken with.

    Parameters
    ----------
    uv
        (N, 2) pixels.
    depth_m
        (N,) metres.
    roll_rad, pitch_rad
        Attitude of the observer.
    sigma_depth_m
        (N,) standard deviation of the depth, 0 where it is not known. None: nowhere.
    """

    uv: Array
    depth_m: Array
    roll_rad: float
    pitch_rad: float
    sigma_depth_m: Array | None = None
