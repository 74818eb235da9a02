"""Faults of yaw rates."""

import numpy as np

from label_judge.flights import draw_walk
from label_judge.injection import (
    GYRO,
    OWN,
    PEER,
    VX,
    Row,
    both,
    delay,
    draw_pulses,
    hold,
    ramp_up,
    select_part,
    select_seconds,
    silence,
    yaw,
)

GYRO_RAMP = yaw(OWN, lambda v, t, g, s, r: v + s * ramp_up(t, g))
GYRO_CONSTANT = yaw(PEER, lambda v, t, g, s, r: v + s)


YAW_ROWS = (
    Row("gyro bias", GYRO_CONSTANT, 0.05, GYRO, PEER),
    Row("gyro bias, own", yaw(OWN, lambda v, t, g, s, r: v + s), 0.05, GYRO, OWN),
    Row("gyro bias ramps", GYRO_RAMP, 0.05, GYRO, OWN),
    Row(
        "gyro bias ramps there and back",
        yaw(PEER, lambda v, t, g, s, r: v + s * np.sin(2 * np.pi * ramp_up(t, g))),
        0.06,
        GYRO,
        PEER,
    ),
    Row(
        "gyro bias walks",
        yaw(PEER, lambda v, t, g, s, r: v + s * draw_walk(r, t, 30.0)),
        0.03,
        GYRO,
        PEER,
    ),
    Row(
        "gyro bias jumps",
        yaw(OWN, lambda v, t, g, s, r: v + s * select_part(t, g, (0.45, 9.0))),
        0.06,
        GYRO,
        OWN,
    ),
    Row(
        "both gyros off",
        both((GYRO_CONSTANT, 1.0), (yaw(OWN, lambda v, t, g, s, r: v - s), 0.7)),
        0.04,
        GYRO,
    ),
    Row(
        "yaw estimate reset",
        yaw(OWN, lambda v, t, g, s, r: v + s * 10 * select_seconds(t, g, 0.1, 0.4)),
        0.8,
        GYRO,
        OWN,
    ),
    Row(
        "yaw estimate reset thrice",
        yaw(PEER, lambda v, t, g, s, r: v + s * 10 * select_seconds(t, g, 0.1, 0.2, 0.5, 0.75)),
        0.4,
        GYRO,
        PEER,
    ),
    Row(
        "yaw rate spikes",
        yaw(OWN, lambda v, t, g, s, r: v + draw_pulses(r, len(v), 40, s)),
        20.0,
        GYRO,
        OWN,
    ),
    Row("yaw rate scaled", yaw(OWN, lambda v, t, g, s, r: v * (1 + s)), 0.15, GYRO, OWN),
    Row("yaw rate negated", yaw(PEER, lambda v, t, g, s, r: -v), 0.0, GYRO, PEER),
    Row("yaw rate in degrees", yaw(PEER, lambda v, t, g, s, r: np.degrees(v)), 0.0, GYRO, PEER),
    Row(
        "yaw rate silent",
        yaw(PEER, lambda v, t, g, s, r: v + silence(select_seconds(t, g, s, 0.4))),
        10.0,
        GYRO,
        PEER,
    ),
    Row(
        "yaw rate held",
        yaw(PEER, lambda v, t, g, s, r: hold(v, select_seconds(t, g, s, 0.3, 0.7))),
        6.0,
        GYRO,
        PEER,
    ),
    Row(
        "yaw rate noisy",
        yaw(PEER, lambda v, t, g, s, r: v + r.normal(0, s, len(v))),
        0.5,
        GYRO,
        PEER,
    ),
    Row(
        "yaw rate saturates",
        yaw(PEER, lambda v, t, g, s, r: np.clip(v, 0.6 * s - 0.6, 0.6 - 0.6 * s)),
        0.7,
        GYRO,
        PEER,
    ),
    Row("yaw rate late", yaw(PEER, lambda v, t, g, s, r: delay(v, t, s)), 0.3, GYRO, PEER),
    Row(
        "yaw rate follows the speed",
        yaw(OWN, lambda v, t, g, s, r: v + s * g.robots[OWN][VX]),
        0.3,
        GYRO,
        OWN,
    ),
    Row(
        "gyro warms up",
        yaw(PEER, lambda v, t, g, s, r: v + s * np.exp(-t / 15.0)),
        0.12,
        GYRO,
        PEER,
    ),
)
