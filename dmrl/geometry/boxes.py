"""Boxes of objects in images: left, top, right and bottom, pixels."""

from collections.abc import Sequence

from dmrl.geometry.frames import Camera


def square_box(
    camera: Camera, u_px: float, v_px: float, depth_m: float, width_m: float
) -> list[float]:
    """Return the square box, around a pixel, of an object of a width at a depth, metres."""
    half_px = camera.fx_px * width_m / depth_m / 2
    return [u_px - half_px, v_px - half_px, u_px + half_px, v_px + half_px]


def clip_box(box_px: Sequence[float], width_px: int, height_px: int) -> list[float]:
    """Return the part of a box inside an image of a size; outside, a box without area."""
    most = (width_px, height_px, width_px, height_px)
    return [min(max(edge, 0.0), float(end)) for edge, end in zip(box_px, most, strict=True)]
