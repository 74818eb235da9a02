"""Errors that a calibration assumes. Imports nothing heavy: help shows its defaults."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations: of a detection in pixels, of roll and pitch in radians."""

    pixel_std_px: float = 4.0
    attitude_std_rad: float = 0.015
