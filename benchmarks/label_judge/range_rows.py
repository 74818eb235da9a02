"""Faults of ranges."""

import numpy as np

from label_judge.flights import BOTH, Logs, draw_spans, draw_walk
from label_judge.injection import (
    CLOCK,
    OWN,
    PEER,
    RANGE,
    Row,
    delay,
    find_bearing,
    find_place,
    hold,
    ramp_up,
    ranges,
    select_part,
    select_seconds,
)


def drop_link(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Remove the ranges that the second robot measured."""
    logs.ranges[PEER, OWN] = logs.ranges[PEER, OWN][:, :0]


def thin_ranges(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Remove a share of the ranges, in spans of half a second."""
    for link in BOTH:
        time_s = logs.ranges[link][0]
        kept = draw_spans(rng, time_s, 0.5) >= size
        logs.ranges[link] = logs.ranges[link][:, kept]


def silence_ranges(logs: Logs, size: float, rng: np.random.Generator) -> None:
    """Remove the ranges for so many seconds in the middle of the flight."""
    for link in BOTH:
        time_s = logs.ranges[link][0]
        logs.ranges[link] = logs.ranges[link][:, select_seconds(time_s, logs, size, 0.5) == 0]


RANGE_OFFSET = ranges(lambda v, t, g, s, r, k: v + s)
RANGE_BURSTS = ranges(
    lambda v, t, g, s, r, k: (
        v
        + select_seconds(t, g, 3.0, 0.1, 0.22, 0.38, 0.5, 0.63, 0.8) * r.uniform(-s, 2 * s, len(v))
    )
)


RANGE_ROWS = (
    Row("range offset", RANGE_OFFSET, 0.35, RANGE),
    Row("range offset, short", ranges(lambda v, t, g, s, r, k: v - s), 0.25, RANGE),
    Row(
        "range offset of one direction",
        ranges(lambda v, t, g, s, r, k: v + s, BOTH[0]),
        0.3,
        RANGE,
    ),
    Row("range error by distance", ranges(lambda v, t, g, s, r, k: v + s * v**2), 0.04, RANGE),
    Row("range scale", ranges(lambda v, t, g, s, r, k: v * (1 + s)), 0.1, RANGE),
    Row(
        "range steps",
        ranges(lambda v, t, g, s, r, k: v + s * select_part(t, g, (0.5, 9.0))),
        0.4,
        RANGE,
    ),
    Row(
        "range steps up and down",
        ranges(
            lambda v, t, g, s, r, k: v + s * (draw_spans(np.random.default_rng(3), t, 9.0) > 0.5)
        ),
        0.4,
        RANGE,
    ),
    Row("range drifts", ranges(lambda v, t, g, s, r, k: v + s * ramp_up(t, g)), 0.5, RANGE),
    Row(
        "range frozen",
        ranges(lambda v, t, g, s, r, k: hold(v, select_seconds(t, g, s, 0.2, 0.5, 0.8))),
        5.0,
        RANGE,
    ),
    Row(
        "ranges repeat old values",
        ranges(lambda v, t, g, s, r, k: hold(v, (r.random(len(v)) < s).astype(float))),
        0.85,
        RANGE,
    ),
    Row(
        "range outliers",
        ranges(lambda v, t, g, s, r, k: v + (r.random(len(v)) < s) * r.uniform(-1, 3, len(v))),
        0.25,
        RANGE,
    ),
    Row(
        "short outliers",
        ranges(lambda v, t, g, s, r, k: v - (r.random(len(v)) < s) * r.uniform(0.2, 1, len(v))),
        0.25,
        RANGE,
    ),
    Row(
        "eight bursts of detours",
        ranges(
            lambda v, t, g, s, r, k: (
                v + s * select_seconds(t, g, 3.0, 0.06, 0.17, 0.29, 0.41, 0.53, 0.66, 0.78, 0.9)
            )
        ),
        1.0,
        RANGE,
    ),
    Row(
        "antenna delay by bearing",
        ranges(lambda v, t, g, s, r, k: v + s * np.cos(find_bearing(g, k, t))),
        0.15,
        RANGE,
    ),
    Row(
        "antenna with two harmonics",
        ranges(
            lambda v, t, g, s, r, k: (
                v + s * (np.sin(find_bearing(g, k, t)) + 0.7 * np.cos(2 * find_bearing(g, k, t)))
            )
        ),
        0.15,
        RANGE,
    ),
    Row(
        "body shadow behind",
        ranges(lambda v, t, g, s, r, k: v + s * (np.cos(find_bearing(g, k, t)) < -0.5)),
        0.4,
        RANGE,
    ),
    Row(
        "multipath in one place",
        ranges(lambda v, t, g, s, r, k: v + s * (find_place(g, PEER, t)[:, 0] > 0.7)),
        0.5,
        RANGE,
    ),
    Row(
        "multipath by distance",
        ranges(lambda v, t, g, s, r, k: v + s * np.sin(2 * np.pi * v / 0.8)),
        0.2,
        RANGE,
    ),
    Row("range noisy", ranges(lambda v, t, g, s, r, k: v + r.normal(0, s, len(v))), 0.4, RANGE),
    Row(
        "range fades",
        ranges(lambda v, t, g, s, r, k: v + s * draw_walk(r, t, 5.0)),
        0.2,
        RANGE,
    ),
    Row("ranges silent", silence_ranges, 30.0, RANGE),
    Row("ranges lost in bursts", thin_ranges, 0.9, RANGE),
    Row("one direction missing", drop_link, 0.0, ""),
    Row("ranges in cm", ranges(lambda v, t, g, s, r, k: 100 * v), 0.0, RANGE),
    Row("ranges in feet", ranges(lambda v, t, g, s, r, k: v / 0.3048), 0.0, RANGE),
    Row("ranges late", ranges(lambda v, t, g, s, r, k: delay(v, t, s)), 0.3, RANGE + "|" + CLOCK),
    Row("ranges rounded", ranges(lambda v, t, g, s, r, k: np.round(v / s) * s), 0.4, RANGE),
    Row("ranges saturate", ranges(lambda v, t, g, s, r, k: np.minimum(v, 2.2 - s)), 0.8, RANGE),
)
