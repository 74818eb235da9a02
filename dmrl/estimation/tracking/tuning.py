"""Errors and times that the tracker assumes. Imports nothing heavy: help shows its defaults."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Tuning:
    """Expected errors of detector, robots and sensors.

    Errors and correlation times were measured on eight rendered flights with dmrl-nano; see
    docs/tracking.md. The other values were chosen there by the share of followed peers, at one
    false track a minute.

    Parameters
    ----------
    pixel_std_px
        Error of a detection in u and in v.
    depth_std_ratio, depth_bias_ratio, depth_bias_s
        Error of a detection's depth over the depth: the part that is new in every image, unless the
        detection has its own; the part that lasts; its correlation time.
    speed_std_mps, climb_std_mps, velocity_s
        Speed of a peer in each horizontal direction and vertically, and its correlation time.
    own_drift_m, own_height_std_m, yaw_drift_rad
        Errors of the observer's own motion: horizontally, in the root of a second; in height
        between two images; and of its heading, in the root of a second.
    tilt_std_rad, tilt_bias_rad
        Errors of roll and pitch: the part that is new in every image, and the part that stays for
        a flight.
    seen_share, silent_share
        Share of the images with a peer in view in which it is detected, while the network sees it
        and while it is silent.
    visibility_s
        Correlation time of these two states.
    edge_px
        Width of the margin of the image in which the detection probability falls.
    capture_std_m
        Error of a silent track that may follow a false object.
    confidence_s
        Correlation time of a detection's confidence.
    appearing_per_s
        Mean number of peers that come into view in a second.
    leaving_s
        Mean time after which a peer is gone for good.
    lasting_false_share, lasting_false_s
        Share of the false alarms that stay at their place, and their mean duration.
    gate
        Probability that a peer's own detection passes the gate, 0 to 1.
    confirm, keep
        Probability of existence at which a track is reported, and below which it is not reported
        any more.
    lost_std_m
        Standard deviation of the position at which a track is deleted.
    """

    pixel_std_px: float = 1.8
    depth_std_ratio: float = 0.10
    depth_bias_ratio: float = 0.15
    depth_bias_s: float = 1.5
    speed_std_mps: float = 0.4
    climb_std_mps: float = 0.1
    velocity_s: float = 0.7
    own_drift_m: float = 0.06
    own_height_std_m: float = 0.01
    yaw_drift_rad: float = 0.01
    tilt_std_rad: float = 0.005
    tilt_bias_rad: float = 0.01
    seen_share: float = 0.95
    silent_share: float = 0.03
    visibility_s: float = 4.0
    edge_px: float = 8.0
    capture_std_m: float = 0.25
    confidence_s: float = 0.5
    appearing_per_s: float = 0.3
    leaving_s: float = 200.0
    lasting_false_share: float = 0.3
    lasting_false_s: float = 5.0
    gate: float = 0.997
    confirm: float = 0.6
    keep: float = 0.05
    lost_std_m: float = 1.5
