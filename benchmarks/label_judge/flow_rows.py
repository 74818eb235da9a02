"""Faults of the velocities from optical flow."""

import numpy as np

from label_judge.flights import Array, Logs, draw_spans, draw_walk
from label_judge.injection import (
    CLOCK,
    FLOW,
    OWN,
    PEER,
    VX,
    VY,
    YAW,
    Row,
    both,
    delay,
    filter_low,
    find_place,
    flow,
    hold,
    ramp_up,
    select_part,
    select_seconds,
    silence,
)


def turn_flow(logs: Logs, robot: str, angle: Array | float) -> None:
    """Turn the velocities of a robot by an angle, radians."""
    log = logs.robots[robot]
    x, y, c, s = log[VX], log[VY], np.cos(angle), np.sin(angle)
    log[VX], log[VY] = c * x - s * y, s * x + c * y


def rotate_flow(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Turn the velocities by an angle, as of a flow sensor that is mounted askew."""
    turn_flow(logs, PEER, size)


def put_flow_in_world(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Express velocities in the world frame in place of the horizontal frame of the robot."""
    truth = logs.flight.truth[PEER]
    turn_flow(logs, PEER, np.interp(logs.robots[PEER]["time_s"], truth.time_s, truth.yaw))


def put_flow_in_take_off(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Express velocities in the horizontal frame that the robot had at take-off."""
    truth = logs.flight.truth[PEER]
    yaw = truth.yaw - truth.yaw[0]
    turn_flow(logs, PEER, np.interp(logs.robots[PEER]["time_s"], truth.time_s, yaw))


def swap_axes(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Swap the columns of the velocities."""
    log = logs.robots[PEER]
    log[VX], log[VY] = log[VY], log[VX]


def delay_flow(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Delay the velocities of one robot."""
    log = logs.robots[PEER]
    for name in (VX, VY):
        log[name] = delay(log[name], log["time_s"], size)


FLOW_SCALE = flow(PEER, lambda v, t, g, s, r: v * (1 + s))


FLOW_ROWS = (
    Row("flow scale", FLOW_SCALE, 0.15, FLOW, PEER),
    Row(
        "flow scale by axis",
        both(
            (flow(PEER, lambda v, t, g, s, r: v * (1 + s), VX), 1.0),
            (flow(PEER, lambda v, t, g, s, r: v * (1 - s), VY), 1.0),
        ),
        0.1,
        FLOW,
        PEER,
    ),
    Row(
        "flow scale follows height",
        flow(PEER, lambda v, t, g, s, r: v * (1 + s * (find_place(g, PEER, t)[:, 2] - 1))),
        1.0,
        FLOW,
        PEER,
    ),
    Row(
        "flow scale changes",
        flow(OWN, lambda v, t, g, s, r: v * (1 + s * select_part(t, g, (0.5, 9.0)))),
        0.25,
        FLOW,
        OWN,
    ),
    Row(
        "flow slow over one place",
        flow(OWN, lambda v, t, g, s, r: v * (1 - s * (find_place(g, OWN, t)[:, 0] > 0.3))),
        0.4,
        FLOW,
        OWN,
    ),
    Row(
        "flow stuck",
        flow(OWN, lambda v, t, g, s, r: v * (1 - select_seconds(t, g, s, 0.45))),
        10.0,
        FLOW,
        OWN,
    ),
    Row(
        "flow stuck in spells",
        flow(PEER, lambda v, t, g, s, r: v * (draw_spans(np.random.default_rng(5), t, 1.0) >= s)),
        0.15,
        FLOW,
        PEER,
    ),
    Row(
        "flow silent",
        flow(PEER, lambda v, t, g, s, r: v + silence(select_seconds(t, g, s, 0.6))),
        5.0,
        FLOW,
        PEER,
    ),
    Row(
        "flow held",
        flow(PEER, lambda v, t, g, s, r: hold(v, select_seconds(t, g, s, 0.25, 0.6, 0.85))),
        4.0,
        FLOW,
        PEER,
    ),
    Row(
        "flow noisy",
        flow(PEER, lambda v, t, g, s, r: v + r.normal(0, s, len(v))),
        0.6,
        FLOW,
        PEER,
    ),
    Row(
        "flow noisy for a while",
        flow(
            OWN, lambda v, t, g, s, r: v + s * draw_walk(r, t, 0.3) * select_part(t, g, (0.3, 0.55))
        ),
        0.4,
        FLOW,
        OWN,
    ),
    Row(
        "flow wanders",
        flow(PEER, lambda v, t, g, s, r: v + s * draw_walk(r, t, 8.0)),
        0.12,
        FLOW,
        PEER,
    ),
    Row("flow biased", flow(PEER, lambda v, t, g, s, r: v + s, VX), 0.1, FLOW, PEER),
    Row(
        "flow bias ramps",
        flow(PEER, lambda v, t, g, s, r: v + s * ramp_up(t, g), VY),
        0.15,
        FLOW,
        PEER,
    ),
    Row(
        "flow bias jumps",
        flow(OWN, lambda v, t, g, s, r: v + s * select_part(t, g, (0.35, 0.65)), VY),
        0.15,
        FLOW,
        OWN,
    ),
    Row("flow mounted askew", rotate_flow, 0.17, FLOW, PEER),
    Row("vy negated", flow(PEER, lambda v, t, g, s, r: -v, VY), 0.0, FLOW, PEER),
    Row("vx negated", flow(OWN, lambda v, t, g, s, r: -v, VX), 0.0, FLOW, OWN),
    Row("vx and vy swapped", swap_axes, 0.0, FLOW, PEER),
    Row("velocity in the world frame", put_flow_in_world, 0.0, FLOW + "|frame|world", PEER),
    Row("velocity in the take-off frame", put_flow_in_take_off, 0.0, FLOW + "|frame|world", PEER),
    Row("velocity in cm/s", flow(PEER, lambda v, t, g, s, r: 100 * v), 0.0, FLOW, PEER),
    Row(
        "flow saturates",
        flow(PEER, lambda v, t, g, s, r: np.clip(v, s - 1, 1 - s)),
        0.7,
        FLOW,
        PEER,
    ),
    Row(
        "flow outliers",
        flow(PEER, lambda v, t, g, s, r: v + (r.random(len(v)) < s) * r.uniform(-3, 3, len(v))),
        0.1,
        FLOW,
        PEER,
    ),
    Row("flow late", delay_flow, 0.3, FLOW + "|" + CLOCK, PEER),
    Row("flow lags", flow(PEER, lambda v, t, g, s, r: filter_low(v, s)), 0.4, FLOW, PEER),
    Row(
        "flow follows the turning",
        flow(PEER, lambda v, t, g, s, r: v + s * g.robots[PEER][YAW], VY),
        0.15,
        FLOW,
        PEER,
    ),
)
