"""Faults of heights, clocks and motion, and combinations of faults."""

from collections.abc import Callable

import numpy as np

from dmrl.flight import Fault
from label_judge.flights import Array, Logs
from label_judge.flow_rows import FLOW_SCALE
from label_judge.injection import (
    CLOCK,
    FLOW,
    GYRO,
    HEIGHT,
    MOTION,
    OWN,
    PEER,
    RANGE,
    Injector,
    Row,
    both,
    column,
    draw_pulses,
    height,
    nothing,
    ramp_up,
    ranges,
    select_part,
    select_seconds,
    silence,
)
from label_judge.range_rows import RANGE_BURSTS, RANGE_OFFSET
from label_judge.yaw_rows import GYRO_CONSTANT, GYRO_RAMP


def swap_robots(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Swap the logs of the robots."""
    logs.robots[OWN], logs.robots[PEER] = logs.robots[PEER], logs.robots[OWN]


def shift_clock(of: Callable[[Array, Logs], Array]) -> Injector:
    """Return an injector that shifts all times of the second robot's clock, also of its truth."""

    def inject(logs: Logs, size: float, rng: np.random.Generator) -> None:
        log, link = logs.robots[PEER], (PEER, OWN)
        log["time_s"] = log["time_s"] + size * of(log["time_s"], logs)
        logs.ranges[link][0] += size * of(logs.ranges[link][0], logs)
        logs.truth[link][:, 0] += size * of(logs.truth[link][:, 0], logs)

    return inject


OTHER_ROWS = (
    Row(
        "height drifts",
        height(PEER, lambda v, t, g, s, r: v + s * ramp_up(t, g)),
        0.8,
        HEIGHT,
        PEER,
    ),
    Row(
        "height saturates",
        height(PEER, lambda v, t, g, s, r: np.minimum(v, 1.2 - s)),
        0.4,
        HEIGHT,
        PEER,
    ),
    Row(
        "height steps",
        height(PEER, lambda v, t, g, s, r: v - s * select_seconds(t, g, 3.0, 0.2, 0.5, 0.8)),
        0.35,
        HEIGHT,
        PEER,
    ),
    Row(
        "height steps and stays",
        height(OWN, lambda v, t, g, s, r: v + s * select_part(t, g, (0.5, 9.0))),
        0.6,
        HEIGHT,
        OWN,
    ),
    Row("height off", height(PEER, lambda v, t, g, s, r: v + s), 0.5, HEIGHT, PEER),
    Row("height scaled", height(PEER, lambda v, t, g, s, r: v * (1 + s)), 0.4, HEIGHT, PEER),
    Row(
        "height silent",
        height(OWN, lambda v, t, g, s, r: v + silence(select_seconds(t, g, s, 0.5))),
        10.0,
        HEIGHT,
        OWN,
    ),
    Row(
        "height noisy",
        height(PEER, lambda v, t, g, s, r: v + r.normal(0, s, len(v))),
        0.3,
        HEIGHT,
        PEER,
    ),
    Row(
        "height spikes",
        height(PEER, lambda v, t, g, s, r: v + draw_pulses(r, len(v), 200, s)),
        1.0,
        HEIGHT,
        PEER,
    ),
    Row("height in cm", height(PEER, lambda v, t, g, s, r: 100 * v), 0.0, HEIGHT, PEER),
    Row("clock ahead", shift_clock(lambda t, g: np.ones(len(t))), 0.3, CLOCK, PEER),
    Row("clock 50 ms ahead", shift_clock(lambda t, g: np.ones(len(t))), 0.05, CLOCK, PEER),
    Row("clock drifts", shift_clock(lambda t, g: t), 3e-3, CLOCK, PEER),
    Row("clock jumps", shift_clock(lambda t, g: select_part(t, g, (0.5, 9.0))), 0.4, CLOCK, PEER),
    Row("clock seconds off", shift_clock(lambda t, g: np.full(len(t), 3.0)), 1.0, CLOCK, PEER),
    Row("robots swapped", swap_robots, 0.0, "swap|robot|other"),
    Row(
        "roll and pitch off",
        column(PEER, "roll_rad", "pitch_rad")(lambda v, t, g, s, r: v + s),
        0.08,
        "",
        PEER,
    ),
    Row("landing", nothing, 0.0, MOTION, PEER, (Fault("landing", PEER),)),
    Row("crash", nothing, 0.0, MOTION + "|" + FLOW, PEER, (Fault("crash", PEER),)),
    Row(
        "bursts of bad ranges, gyro ramp",
        both((RANGE_BURSTS, 0.5), (GYRO_RAMP, 0.05)),
        1.0,
        GYRO + "|" + RANGE,
        OWN,
    ),
    Row(
        "range offset, flow scale",
        both((RANGE_OFFSET, 0.35), (FLOW_SCALE, 0.15)),
        1.0,
        RANGE + "|" + FLOW,
    ),
    Row(
        "gyro bias, range steps",
        both(
            (GYRO_CONSTANT, 0.05),
            (ranges(lambda v, t, g, s, r, k: v + s * select_part(t, g, (0.4, 0.7))), 0.4),
        ),
        1.0,
        GYRO + "|" + RANGE,
    ),
    Row(
        "flow scale, clock ahead",
        both((FLOW_SCALE, 0.12), (shift_clock(lambda t, g: np.ones(len(t))), 0.15)),
        1.0,
        FLOW + "|" + CLOCK,
        PEER,
    ),
)
