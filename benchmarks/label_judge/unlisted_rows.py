"""Faults that no error model of `dmrl label` describes; the test of the fit has to find them.

Signals, sizes and seeds were fixed on 27 November 2026, before that test was written.
"""

from dataclasses import replace

import numpy as np

from label_judge.flights import BOTH, Array, Base, Logs, draw_spans, fly
from label_judge.injection import (
    FLOW,
    GYRO,
    OWN,
    PEER,
    RANGE,
    VX,
    VY,
    YAW,
    H,
    Row,
    filter_low,
    find_place,
    flow,
    ranges,
    select_part,
    select_seconds,
    yaw,
)


def swap_axes(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Swap vx and vy during a share of the flight."""
    log = logs.robots[PEER]
    at = select_part(log["time_s"], logs, (0.5 - size / 2, 0.5 + size / 2)) > 0
    log[VX], log[VY] = np.where(at, log[VY], log[VX]), np.where(at, log[VX], log[VY])


def splice_flight(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Replace so many seconds of a robot's log by those of another flight."""
    other = fly(Base("room", "calibrated", logs.end_s, 990))
    log, from_s = logs.robots[PEER], other.robots[PEER]["time_s"]
    at = select_seconds(log["time_s"], logs, size, 0.5) > 0
    for name in (VX, VY, YAW, H):
        there = np.interp(log["time_s"], from_s, np.nan_to_num(other.robots[PEER][name]))
        log[name] = np.where(at, there, log[name])


def swap_odometry(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Swap the odometry of both robots during the last share of the flight."""
    logs_of = [logs.robots[robot] for robot in (OWN, PEER)]
    first = [log["time_s"] >= (1 - size) * logs.end_s for log in logs_of]
    for name in (VX, VY, YAW):
        each = [
            np.where(at, np.interp(a["time_s"], b["time_s"], np.nan_to_num(b[name])), a[name])
            for at, a, b in zip(first, logs_of, logs_of[::-1], strict=True)
        ]
        for log, values in zip(logs_of, each, strict=True):
            log[name] = values


def measure_stranger(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Replace so many seconds of ranges, twice, by those of another flight."""
    other = fly(replace(Base("random", "calibrated", logs.end_s, 991)))
    for link in BOTH:
        time_s, range_m = logs.ranges[link]
        at = select_seconds(time_s, logs, size, 0.35, 0.7) > 0
        there = np.interp(time_s, *other.ranges[link])
        logs.ranges[link] = np.stack([time_s, np.where(at, there, range_m)])


def _smooth_ranges(range_m: Array, time_s: Array, size: float) -> Array:
    """Return ranges that a driver filters with a time constant of ``size`` seconds."""
    grid_s = np.arange(time_s[0], time_s[-1] + 0.01, 0.01)
    return np.interp(time_s, grid_s, filter_low(np.interp(grid_s, time_s, range_m), size))


UNLISTED_ROWS = (
    Row(
        "ranges averaged by the driver",
        ranges(lambda v, t, g, s, r, k: _smooth_ranges(v, t, s)),
        0.5,
        RANGE,
    ),
    Row("vx and vy exchanged for a while", swap_axes, 0.3, FLOW, PEER),
    Row("yaw rate averaged", yaw(PEER, lambda v, t, g, s, r: filter_low(v, s)), 0.5, GYRO, PEER),
    Row("ranges to a stranger", measure_stranger, 10.0, RANGE),
    Row("log of another flight", splice_flight, 20.0, FLOW + "|" + GYRO, PEER),
    Row("odometry exchanged at the end", swap_odometry, 0.4, FLOW + "|" + GYRO),
    Row(
        "ranges long and noisy in half of the room",
        ranges(
            lambda v, t, g, s, r, k: (
                v + s * (find_place(g, OWN, t)[:, 1] > 0) * (1 + r.uniform(-1, 1, len(v)))
            )
        ),
        0.5,
        RANGE,
    ),
    Row(
        "yaw rate wraps",
        yaw(OWN, lambda v, t, g, s, r: (v + s) % (2 * s) - s),
        0.6,
        GYRO,
        OWN,
    ),
    Row("flow without sign", flow(PEER, lambda v, t, g, s, r: np.abs(v), VX), 0.0, FLOW, PEER),
    Row(
        "slow flow reads zero",
        flow(PEER, lambda v, t, g, s, r: np.where(np.abs(v) < s, 0.0, v)),
        0.2,
        FLOW,
        PEER,
    ),
    Row(
        "every other second of ranges long",
        ranges(lambda v, t, g, s, r, k: v + s * (t.astype(int) % 2)),
        0.4,
        RANGE,
    ),
    Row(
        "ranges grow with the square",
        ranges(lambda v, t, g, s, r, k: v + s * v**2),
        0.1,
        RANGE,
    ),
    Row(
        "yaw rate swings",
        yaw(PEER, lambda v, t, g, s, r: v + s * np.sin(2 * np.pi * 0.2 * t)),
        0.3,
        GYRO,
        PEER,
    ),
    Row(
        "flow scale changes every second",
        flow(OWN, lambda v, t, g, s, r: v * (1 + s * (2 * draw_spans(r, t, 1.0) - 1))),
        0.6,
        FLOW,
        OWN,
    ),
)
