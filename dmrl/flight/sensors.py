"""Simulated sensor measurements of a robot's true motion."""

import numpy as np
from numpy.random import Generator

from dmrl.flight.flight_arrays import RATE_HZ, Clock, Ranges, RobotLog, Truth, scan_values
from dmrl.flight.noise import Noise
from dmrl.geometry.frames import Array


def draw_coloured_noise(rng: Generator, samples: int, std: float, tau_s: float) -> Array:
    """Draw (samples,) stationary first-order noise with time constant ``tau_s``."""
    keep = float(np.exp(-1.0 / (RATE_HZ * tau_s)))
    steps = rng.normal(0.0, std, samples)
    steps[1:] *= np.sqrt(1.0 - keep**2)
    return scan_values(lambda x, w: keep * x + w, steps)


def simulate_log(
    rng: Generator, truth: Truth, yaw_rate: Array, clock: Clock, noise: Noise
) -> RobotLog:
    """Simulate the log of a robot.

    Parameters
    ----------
    rng
        Random generator.
    truth
        Ground truth of the robot.
    yaw_rate
        (N,) its true yaw rate, radians per second.
    clock
        Its clock.
    noise
        Errors of its sensors.
    """
    samples = len(truth.time_s)

    def measure(true: Array, white: float, bias: float) -> Array:
        return np.asarray(true + rng.normal(0.0, bias) + rng.normal(0.0, white, samples))

    velocity = _simulate_velocity(rng, truth, noise)
    return RobotLog(
        time_s=clock.to_clock_time(truth.time_s),
        roll_rad=measure(truth.roll, noise.attitude_white_rad, noise.attitude_bias_rad),
        pitch_rad=measure(truth.pitch, noise.attitude_white_rad, noise.attitude_bias_rad),
        yaw_rate_radps=measure(yaw_rate, noise.yaw_rate_white_radps, noise.yaw_rate_bias_radps),
        vx_mps=velocity[0],
        vy_mps=velocity[1],
        height_m=measure(truth.position[:, 2], noise.height_white_m, noise.height_bias_m),
    )


def _simulate_velocity(rng: Generator, truth: Truth, noise: Noise) -> Array:
    """Simulate (2, N) velocities from optical flow, in the robot's horizontal frame."""
    samples = len(truth.time_s)
    x, y, _ = truth.velocity.T
    c, s = np.cos(truth.yaw), np.sin(truth.yaw)
    scale = 1.0 + rng.normal(0.0, noise.velocity_scale)
    bias = rng.normal(0.0, noise.velocity_bias_mps, (2, 1))
    white = rng.normal(0.0, noise.velocity_white_mps, (2, samples))
    slow = [
        draw_coloured_noise(rng, samples, noise.velocity_coloured_mps, noise.velocity_tau_s)
        for _ in range(2)
    ]
    return np.asarray(scale * np.stack([c * x + s * y, c * y - s * x]) + bias + white + slow)


def draw_pair_errors(rng: Generator, noise: Noise) -> tuple[float, float]:
    """Draw bias (metres) and scale (a factor) of one pair's ranges, for a flight."""
    return float(rng.normal(0.0, noise.uwb_bias_m)), float(1 + rng.normal(0.0, noise.uwb_scale))


def simulate_ranges(
    rng: Generator,
    observer: Truth,
    peer: Truth,
    clock: Clock,
    noise: Noise,
    errors: tuple[float, float],
) -> Ranges:
    """Simulate the ranges from one robot to another.

    Parameters
    ----------
    rng
        Random generator.
    observer, peer
        Ground truth of the robot that ranges, and of the one that answers.
    clock
        Clock of the robot that ranges.
    noise
        Errors and rate of the ranges.
    errors
        Bias and scale of the pair.
    """
    period_s = 1.0 / noise.ranging_rate_hz
    time_s = np.arange(rng.uniform(0.0, period_s), observer.time_s[-1], period_s)
    distance = np.linalg.norm(peer.position_at(time_s) - observer.position_at(time_s), axis=1)
    bias_m, scale = errors
    detour = rng.exponential(noise.nlos_mean_m, len(time_s))
    detour *= rng.random(len(time_s)) < noise.nlos_share
    measured = scale * distance + bias_m + detour + rng.normal(0.0, noise.uwb_white_m, len(time_s))
    kept = rng.random(len(time_s)) >= noise.ranging_loss
    return Ranges(clock.to_clock_time(time_s[kept]), np.maximum(measured[kept], 0.01))
