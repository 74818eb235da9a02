"""Check whether the values of a recording are in the units of their topics.

Values are counted as messages pass, so that memory is constant. Findings are topic and text.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl.recording.checks.topic_times import TopicTimes
from dmrl.recording.protobuf.arrow_arrays import to_numpy
from dmrl.topics import CAMERA_IMAGE, POSE, SENSORS, TOPICS, TRUE_POSE, UnitCheck, parse_topic

PERIOD_MAX_S, PERIOD_MIN_S = 5.0, 2e-4
"""Longest and shortest plausible median period of a sensor, seconds."""
MESSAGES_MIN = 20
"""Messages needed to measure a period or a magnitude."""
FINITE_TOPICS = ({row.pattern for row in SENSORS} - {CAMERA_IMAGE}) | {POSE, TRUE_POSE}
"""Topics whose values must be finite."""
IMPOSSIBLE = 1000
"""A single value over this many largest plausible ones is reported."""
BELOW_FLOOR_M = -0.3
"""Heights below it are under the floor, and not noise."""


@dataclass(slots=True)
class ValueCounts:
    """Counts of sensor values, by topic and field: all, over and under the limits, not finite."""

    sizes: dict[tuple[str, str], NDArray[np.int64]] = field(
        default_factory=lambda: defaultdict(lambda: np.zeros(3, np.int64))
    )
    not_finite: Counter[tuple[str, str]] = field(default_factory=Counter)
    impossible: Counter[tuple[str, str]] = field(default_factory=Counter)
    below_floor: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add_batch(self, topic: str, batch: pa.RecordBatch) -> None:
        """Add the values of a topic."""
        table = pa.Table.from_batches([batch])
        if any(parse_topic(pattern, topic) for pattern in FINITE_TOPICS):
            while any(map(pa.types.is_struct, table.schema.types)):
                table = table.flatten()
            for one in filter(lambda one: pa.types.is_floating(one.type), table.schema):
                values = to_numpy(table[one.name].drop_null())
                self.not_finite[topic, one.name] += int((~np.isfinite(values)).sum())
        for limit in _find_limits(topic):
            if limit.field in table.schema.names:
                values = to_numpy(table[limit.field].drop_null()).astype(float)
                size = np.abs(values)
                size = size[np.isfinite(size) & (size > 0)]
                counts = len(size), (size > limit.over).sum(), (size < limit.under).sum()
                self.sizes[topic, limit.field] += counts
                self.impossible[topic, limit.field] += int((size > IMPOSSIBLE * limit.over).sum())
                if limit.field == "height_m":
                    self.below_floor[topic, limit.field] += int((values < BELOW_FLOOR_M).sum())

    def find_not_finite_fields(self) -> Iterator[tuple[str, str]]:
        """Yield fields with NaN or infinite values."""
        for (topic, name), count in (+self.not_finite).items():
            yield topic, f"{name}: {count} values are not finite"

    def find_implausible_fields(self) -> Iterator[tuple[str, str]]:
        """Yield fields with values too large or too small for their unit."""
        for (topic, name), (total, over, under) in self.sizes.items():
            limit = next(limit for limit in _find_limits(topic) if limit.field == name)
            if total >= MESSAGES_MIN and under * 10 > total * 9:
                share = f"{name}: {under / total:.0%} of the values are under {limit.under:g}"
                yield topic, f"{share} {limit.unit}. Was their unit larger than the one told?"
            if total >= MESSAGES_MIN and over * 10 > total:
                share = f"{name}: {over / total:.0%} of the values are over {limit.over:g}"
                yield topic, f"{share} {limit.unit}. Are they {limit.perhaps}?"
            elif count := self.impossible[topic, name]:
                most = f"{IMPOSSIBLE * limit.over:g} {limit.unit}"
                share = f"{name}: {count} of {total} values are over {most}"
                yield topic, f"{share}, which no flight gives"
            elif total >= MESSAGES_MIN and 2 * self.below_floor[topic, name] > total:
                share = self.below_floor[topic, name] / total
                yield topic, f"{name}: {share:.0%} of the values are below the floor. Is z down?"


def check_units(topic: str, table: pa.Table) -> list[str]:
    """Return the findings about the values of a topic.

    Parameters
    ----------
    topic
        Name of the topic.
    table
        Messages of the topic, with any of the fields that have a limit.
    """
    counts = ValueCounts()
    for batch in table.to_batches():
        counts.add_batch(topic, batch)
    return [text for _, text in counts.find_implausible_fields()]


def check_periods(
    times: Mapping[str, TopicTimes], sort_times: Callable[[str], TopicTimes]
) -> Iterator[tuple[str, str]]:
    """Yield sensors whose period is so long or short that their times have the wrong unit.

    Parameters
    ----------
    times
        Log times by topic.
    sort_times
        Function that returns the times of a topic that go back, sorted.
    """
    for topic, found in times.items():
        is_sensor = any(parse_topic(row.pattern, topic) for row in SENSORS)
        if len(found) >= MESSAGES_MIN and is_sensor:
            in_order = found if found.shortest_ns >= 0 else sort_times(topic)
            period_s = in_order.compute_median_step_ns(0) * 1e-9
            units = "ms, us or ns" if period_s > PERIOD_MAX_S else "s, ms or us"
            if period_s > PERIOD_MAX_S or 0 < period_s < PERIOD_MIN_S:
                yield topic, f"one message in {period_s:.3g} s. Were its times in {units}?"


def _find_limits(topic: str) -> tuple[UnitCheck, ...]:
    return next((row.doubts for row in TOPICS if parse_topic(row.pattern, topic)), ())
