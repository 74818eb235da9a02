"""Input of the pilot as the network's C and the firmware give it: integers, and SI units."""

from typing import NamedTuple

from dmrl.flight.pilot import Observation

DETECTIONS_MAX = 20


class RawDetection(NamedTuple):
    """A detection as the network's C gives it: 1/16 px, millimetres, confidence of 65536."""

    u_q4: int
    v_q4: int
    depth_mm: int
    confidence: int


class RobotState(NamedTuple):
    """Measurements of the robot: seconds, radians, metres per second along its axes, and metres."""

    time_s: float
    roll_rad: float
    pitch_rad: float
    yaw_rate_radps: float
    vx_mps: float
    vy_mps: float
    height_m: float


def to_raw(seen: Observation) -> tuple[RobotState, float, list[RawDetection]]:
    """Return the arguments of `OnboardFilter.step`: as the C takes them."""
    attitude = seen.roll_rad, seen.pitch_rad, seen.yaw_rate_radps
    vx, vy = seen.velocity_mps.tolist()
    state = RobotState(seen.time_s, *attitude, vx, vy, seen.height_m)
    found = [
        RawDetection(
            round(16 * u_px),
            round(16 * v_px),
            min(round(1000 * depth_m), 65535),
            min(int(65536 * confidence), 65535),
        )
        for u_px, v_px, depth_m, confidence in seen.detections[:DETECTIONS_MAX]
    ]
    image_s = seen.time_s - seen.image_age_s if seen.image_age_s < 1e9 else -1.0
    return state, image_s, found
