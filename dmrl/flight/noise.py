"""Sensor noise: one number per kind of error, and named presets."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Noise:
    """Errors of every sensor, as standard deviations unless noted.

    Errors "per flight" are drawn once per robot, or once per pair of robots.

    Parameters
    ----------
    uwb_white_m
        Noise of each range.
    uwb_bias_m, uwb_scale
        Bias and relative scale error, per flight and pair.
    nlos_share, nlos_mean_m
        Share of ranges without line of sight, 0 to 1; mean of the exponential detour.
    ranging_rate_hz, ranging_loss
        Ranges per second and direction before losses; share of lost ranges, 0 to 1.
    velocity_white_mps, velocity_coloured_mps, velocity_tau_s
        Noise of each sample at 100 Hz, per axis; coloured noise and its time constant.
    velocity_scale, velocity_bias_mps
        Per flight: relative scale error of both axes; bias per axis.
    yaw_rate_white_radps, yaw_rate_bias_radps
        Of each sample; per flight.
    height_white_m, height_bias_m
        Of each sample; per flight.
    attitude_white_rad, attitude_bias_rad
        Of roll and pitch, each sample; per flight.
    clock_offset_s
        Maximum offset of a robot's clock relative to the first robot's, uniform in both directions.
    clock_drift_ppm
        Drift of a robot's clock relative to the first robot's.
    """

    uwb_white_m: float = 0.0
    uwb_bias_m: float = 0.0
    uwb_scale: float = 0.0
    nlos_share: float = 0.0
    nlos_mean_m: float = 0.0
    ranging_rate_hz: float = 50.0
    ranging_loss: float = 0.0
    velocity_white_mps: float = 0.0
    velocity_coloured_mps: float = 0.0
    velocity_tau_s: float = 0.3
    velocity_scale: float = 0.0
    velocity_bias_mps: float = 0.0
    yaw_rate_white_radps: float = 0.0
    yaw_rate_bias_radps: float = 0.0
    height_white_m: float = 0.0
    height_bias_m: float = 0.0
    attitude_white_rad: float = 0.0
    attitude_bias_rad: float = 0.0
    clock_offset_s: float = 0.0
    clock_drift_ppm: float = 0.0


LEVELS = {
    "uwb_white_m": (0.10, 0.10, 0.10),
    "uwb_bias_m": (0.03, 0.10, 0.20),
    "uwb_scale": (0.01, 0.02, 0.03),
    "nlos_share": (0.05, 0.07, 0.12),
    "nlos_mean_m": (0.4, 0.5, 0.8),
    "ranging_loss": (0.15, 0.15, 0.20),
    "velocity_white_mps": (0.10, 0.10, 0.25),
    "velocity_coloured_mps": (0.05, 0.08, 0.12),
    "velocity_scale": (0.02, 0.05, 0.10),
    "velocity_bias_mps": (0.01, 0.015, 0.03),
    "yaw_rate_white_radps": (0.02, 0.02, 0.03),
    "yaw_rate_bias_radps": (0.003, 0.005, 0.01),
    "height_white_m": (0.02, 0.02, 0.03),
    "height_bias_m": (0.01, 0.02, 0.03),
    "attitude_white_rad": (0.005, 0.005, 0.01),
    "attitude_bias_rad": (0.005, 0.01, 0.02),
    "clock_offset_s": (0.0, 0.0, 0.04),
    "clock_drift_ppm": (0.0, 10.0, 20.0),
}
"""Values of the presets "calibrated", "realistic" and "harsh"."""
CALIBRATED, REALISTIC, HARSH = (
    Noise(**dict(zip(LEVELS, values, strict=True))) for values in zip(*LEVELS.values(), strict=True)
)

# Li et al. 2020, the simulation on which the paper's filter was tuned: white noise only, one
# range per step.
PUBLISHED = Noise(
    uwb_white_m=0.1, ranging_rate_hz=100.0, velocity_white_mps=0.25, yaw_rate_white_radps=0.4
)

NOISE: dict[str, Noise] = {
    "ideal": Noise(),
    "calibrated": CALIBRATED,
    "realistic": REALISTIC,
    "harsh": HARSH,
    "published": PUBLISHED,
}
"""Presets by name. Attitude and clock drift are assumed, the rest is measured or published."""
