"""Errors and rates that the tracker assumes. Imports nothing heavy: help shows its defaults."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Tuning:
    """Expected errors of detector, robots and sensors.

    Parameters
    ----------
    pixel_std_px
        Error of a detection in u and in v.
    depth_std_ratio, depth_bias_ratio, depth_bias_s
        Error of a detection's depth over the depth: the part that is new in every image, unless the
        detection has its own; the part that lasts; its correlation time.
    speed_std_mps, acceleration_std_mps2
        Initial speed of a peer, and change of its velocity (in a second).
    own_velocity_std_mps, yaw_rate_std_radps, attitude_std_rad
        Errors of the observer's own sensors. Those of roll and pitch are new in every image.
    detection_share
        Share of the images with a peer in view in which it is detected, 0 to 1.
    false_per_image
        Mean number of false alarms per image.
    gate
        Probability that a peer's own detection passes the gate, 0 to 1.
    confirm_odds, lost_odds
        Odds at which a track is confirmed, and drop of the odds at which it is deleted.
    lost_std_m
        Standard deviation of the position at which a track is deleted.
    """

    pixel_std_px: float = 4.0
    depth_std_ratio: float = 0.12
    depth_bias_ratio: float = 0.08
    depth_bias_s: float = 2.0
    speed_std_mps: float = 0.7
    acceleration_std_mps2: float = 0.8
    own_velocity_std_mps: float = 0.1
    yaw_rate_std_radps: float = 0.05
    attitude_std_rad: float = 0.015
    detection_share: float = 0.7
    false_per_image: float = 0.3
    gate: float = 0.997
    confirm_odds: float = 1e6
    lost_odds: float = 1e4
    lost_std_m: float = 1.0
