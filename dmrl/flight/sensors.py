"""Simulated sensor measurements of a robot's true motion."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from dmrl.flight.flight_arrays import DECIMALS, RATE_HZ, Clock, Ranges, RobotLog, Truth, scan_values
from dmrl.flight.noise import Noise
from dmrl.geometry.frames import Array


def draw_coloured_noise(rng: Generator, samples: int, std: float, tau_s: float) -> Array:
    """Draw (samples,) stationary first-order noise with time constant ``tau_s``."""
    keep = float(np.exp(-1.0 / (RATE_HZ * tau_s)))
    steps = rng.normal(0.0, std, samples)
    steps[1:] *= np.sqrt(1.0 - keep**2)
    return scan_values(lambda x, w: keep * x + w, steps)


@dataclass(frozen=True, slots=True)
class LogErrors:
    """Errors of one robot's sensors at every sample of a flight.

    Rows are vx, vy, roll, pitch, yaw rate and height, in the units of a `RobotLog`.

    Parameters
    ----------
    scale, bias
        (6, 1), constant for the flight.
    white
        (6, N), new in every sample.
    slow
        (2, N), coloured noise of the velocity.
    """

    scale: Array
    bias: Array
    white: Array
    slow: Array


def draw_log_errors(rng: Generator, samples: int, noise: Noise) -> LogErrors:
    """Draw the errors of a robot's log of (samples,)."""
    scale = np.ones((6, 1))
    scale[:2] += rng.normal(0.0, noise.velocity_scale)
    bias = [rng.normal(0.0, noise.velocity_bias_mps, (2, 1))]
    white = [rng.normal(0.0, noise.velocity_white_mps, (2, samples))]
    colour = noise.velocity_coloured_mps, noise.velocity_tau_s
    slow = [draw_coloured_noise(rng, samples, *colour) for _ in range(2)]
    attitude = noise.attitude_bias_rad, noise.attitude_white_rad
    rate = noise.yaw_rate_bias_radps, noise.yaw_rate_white_radps
    for bias_std, white_std in (
        attitude,
        attitude,
        rate,
        (noise.height_bias_m, noise.height_white_m),
    ):
        bias.append(np.array([[rng.normal(0.0, bias_std)]]))
        white.append(rng.normal(0.0, white_std, (1, samples)))
    return LogErrors(scale, np.concatenate(bias), np.concatenate(white), np.stack(slow))


def measure_log(
    truth: Truth, yaw_rate: Array, clock: Clock, errors: LogErrors, part: slice = slice(None)
) -> RobotLog:
    """Measure a robot's motion with its sensors.

    Parameters
    ----------
    truth
        Ground truth of the robot.
    yaw_rate
        (N,) its true yaw rate, radians per second.
    clock
        Its clock.
    errors
        Errors of its sensors.
    part
        Samples to measure.
    """
    x, y = truth.velocity[part, 0], truth.velocity[part, 1]
    c, s = np.cos(truth.yaw[part]), np.sin(truth.yaw[part])
    own = c * x + s * y, c * y - s * x
    height_m = truth.position[part, 2]
    true = np.stack([*own, truth.roll[part], truth.pitch[part], yaw_rate[part], height_m])
    found = errors.scale * true + errors.bias + errors.white[:, part]
    found[:2] += errors.slow[:, part]
    vx, vy, roll, pitch, turning, height = found.round(DECIMALS)
    return RobotLog(
        time_s=clock.to_clock_time(truth.time_s[part]),
        roll_rad=roll,
        pitch_rad=pitch,
        yaw_rate_radps=turning,
        vx_mps=vx,
        vy_mps=vy,
        height_m=height,
    )


def draw_pair_errors(rng: Generator, noise: Noise) -> tuple[float, float]:
    """Draw bias (metres) and scale (a factor) of one pair's ranges, for a flight."""
    return float(rng.normal(0.0, noise.uwb_bias_m)), float(1 + rng.normal(0.0, noise.uwb_scale))


@dataclass(frozen=True, slots=True)
class RangeErrors:
    """Times and errors of the ranges from one robot to another.

    Parameters
    ----------
    time_s
        (M,) true times of the ranges that are received.
    detour_m, white_m
        (M,) errors of each range.
    bias_m, scale
        Of the pair, for the flight.
    """

    time_s: Array
    detour_m: Array
    white_m: Array
    bias_m: float
    scale: float


def draw_range_errors(
    rng: Generator, flight_s: float, noise: Noise, pair: tuple[float, float]
) -> RangeErrors:
    """Draw times and errors of the ranges of a flight.

    Parameters
    ----------
    rng
        Random generator.
    flight_s
        Length of the flight, seconds.
    noise
        Errors and rate of the ranges.
    pair
        Bias and scale of the pair.
    """
    period_s = 1.0 / noise.ranging_rate_hz
    time_s = np.arange(rng.uniform(0.0, period_s), flight_s, period_s)
    detour = rng.exponential(noise.nlos_mean_m, len(time_s))
    detour *= rng.random(len(time_s)) < noise.nlos_share
    white = rng.normal(0.0, noise.uwb_white_m, len(time_s))
    kept = rng.random(len(time_s)) >= noise.ranging_loss
    return RangeErrors(time_s[kept], detour[kept], white[kept], *pair)


def measure_ranges(
    observer: Truth, peer: Truth, clock: Clock, errors: RangeErrors, part: slice = slice(None)
) -> Ranges:
    """Measure the ranges from one robot to another.

    Parameters
    ----------
    observer, peer
        Ground truth of the robot that ranges, and of the one that answers.
    clock
        Clock of the robot that ranges.
    errors
        Times and errors of the ranges.
    part
        Ranges to measure.
    """
    time_s = errors.time_s[part]
    distance = np.linalg.norm(peer.position_at(time_s) - observer.position_at(time_s), axis=1)
    measured = errors.scale * distance + errors.bias_m + errors.detour_m[part]
    measured += errors.white_m[part]
    return Ranges(clock.to_clock_time(time_s), np.maximum(measured, 0.01).round(DECIMALS))
