"""Effects of faults on motion, clocks, logs and ranges of a flight.

A fault changes only the signals it names. All other numbers of the flight stay the same.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from dmrl.flight.faults import FaultEvent
from dmrl.flight.flight_arrays import RATE_HZ, Clock, Ranges, RobotLog
from dmrl.flight.trajectories import Motion
from dmrl.geometry.frames import Array

COAST_TIME_CONSTANT_S = 0.3
"""Time constant of the deceleration after a landing or crash begins."""
LANDING_SPEED_MPS, FALL_ACCELERATION_MPS2 = 0.4, 5.0
FLOOR_HEIGHT_M = 0.02
DIVERGENCE_TIME_CONSTANT_S = 2.0
"""Time constant of the diverging velocity estimate of a crashed robot."""
OUTLIER_ERROR_M = (-1.0, 3.0)
"""Range of the uniform error of an outlier."""
MIN_RANGE_M = 0.01


def land_or_crash(motion: Motion, height_m: Array, end: FaultEvent) -> tuple[Motion, Array]:
    """Return a robot's motion and height with a landing or a crash.

    The robot decelerates along its path and comes to rest. The path stays the same.

    Parameters
    ----------
    motion
        Motion over the floor.
    height_m
        (N,) height above the floor, metres.
    end
        Landing or crash.
    """
    time_s, start_s = np.arange(len(height_m)) / RATE_HZ, end.windows_s[0, 0]
    since = np.maximum(time_s - start_s, 0.0)
    place_s = np.minimum(time_s, start_s) + COAST_TIME_CONSTANT_S * (
        1 - np.exp(-since / COAST_TIME_CONSTANT_S)
    )
    pace = np.exp(-since / COAST_TIME_CONSTANT_S)
    high = float(np.interp(start_s, time_s, height_m))
    if end.fault.kind == "crash":
        fallen = np.minimum(FALL_ACCELERATION_MPS2 * since**2 / 2, high - FLOOR_HEIGHT_M)
    else:
        part = np.minimum(since * LANDING_SPEED_MPS / (high - FLOOR_HEIGHT_M), 1.0)
        fallen = (high - FLOOR_HEIGHT_M) * (1 - np.cos(np.pi * part)) / 2
    return Motion(
        np.interp(place_s, time_s, motion.position),
        np.interp(place_s, time_s, motion.velocity) * pace,
        np.interp(place_s, time_s, motion.yaw),
        np.interp(place_s, time_s, motion.yaw_rate) * pace,
    ), np.where(since > 0, high - fallen, height_m)


def apply_clock_faults(clock: Clock, faults: Sequence[FaultEvent]) -> Clock:
    """Apply clock faults to a robot's clock."""
    for one in faults:
        if one.fault.kind == "clock_drift":
            clock = replace(clock, drift=clock.drift + one.fault.amount * 1e-6)
        if one.fault.kind == "clock_offset":
            clock = replace(clock, offset_s=clock.offset_s + one.fault.amount)
    return clock


def apply_sensor_fault(rng: Generator, log: RobotLog, time_s: Array, event: FaultEvent) -> RobotLog:
    """Apply a sensor fault to a robot's log with true times (N,). Missing measurements are NaN."""
    at, amount = event.is_active(time_s), event.fault.amount
    match event.fault.kind:
        case "yaw_rate_bias":
            return replace(log, yaw_rate_radps=log.yaw_rate_radps + amount * at)
        case "height_step":
            return replace(log, height_m=log.height_m + amount * at)
        case "height_gap":
            return replace(log, height_m=np.where(at, np.nan, log.height_m))
        case "velocity_scale":
            gain = 1 + amount * at
            return replace(log, vx_mps=gain * log.vx_mps, vy_mps=gain * log.vy_mps)
        case "velocity_stuck" | "velocity_gap":
            reads = 0.0 if event.fault.kind == "velocity_stuck" else np.nan
            vx, vy = (np.where(at, reads, v) for v in (log.vx_mps, log.vy_mps))
            return replace(log, vx_mps=vx, vy_mps=vy)
        case "attitude_gap":
            silent = {
                name: np.where(at, np.nan, getattr(log, name))
                for name in ("roll_rad", "pitch_rad", "yaw_rate_radps")
            }
            return replace(log, **silent)
        case "crash":
            since = np.maximum(time_s - event.windows_s[0, 0], 0.0)
            speed = amount * (1 - np.exp(-since / DIVERGENCE_TIME_CONSTANT_S))
            heading = rng.uniform(-np.pi, np.pi)
            vx, vy = log.vx_mps + speed * np.cos(heading), log.vy_mps + speed * np.sin(heading)
            return replace(log, vx_mps=vx, vy_mps=vy)
    return log


def apply_range_fault(rng: Generator, ranges: Ranges, clock: Clock, event: FaultEvent) -> Ranges:
    """Apply a range fault to the ranges from one robot to another."""
    at, amount = event.is_active(clock.to_true_time(ranges.time_s)), event.fault.amount
    if event.fault.kind == "range_gap":
        return Ranges(ranges.time_s[~at], ranges.range_m[~at])
    wrong = amount * at
    if event.fault.kind == "range_outliers":
        wrong = rng.uniform(*OUTLIER_ERROR_M, len(at)) * (at & (rng.random(len(at)) < amount))
    return replace(ranges, range_m=np.maximum(ranges.range_m + wrong, MIN_RANGE_M))
