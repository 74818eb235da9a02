"""Check whether the values of a recording are in the units of their topics.

Magnitudes are counted in logarithmic bins as messages pass, so that memory is constant.
Findings are topic and text.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl.topics import CAMERA_IMAGE, POSE, SENSORS, TRUE_POSE, UnitCheck, parse_topic

PERIOD_MAX_S, PERIOD_MIN_S = 5.0, 1e-5
"""Longest and shortest plausible median period of a sensor, seconds."""
MESSAGES_MIN = 20
"""Messages needed to measure a period or a magnitude."""
BINS_PER_OCTAVE = 4
"""Bins per power of two."""
BIN_COUNT, BIN_OF_ONE = 2048, 1024
"""Number of bins, and the bin of magnitude 1."""
FINITE_TOPICS = ({row.pattern for row in SENSORS} - {CAMERA_IMAGE}) | {POSE, TRUE_POSE}
"""Topics whose values must be finite."""
Times = NDArray[np.int64]


@dataclass(slots=True)
class MagnitudeHistograms:
    """Histograms of the magnitudes of sensor values, by topic and field, in logarithmic bins."""

    counts: dict[tuple[str, str], NDArray[np.int64]] = field(
        default_factory=lambda: defaultdict(lambda: np.zeros(BIN_COUNT, np.int64))
    )
    not_finite: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add_batch(self, topic: str, batch: pa.RecordBatch) -> None:
        """Add the values of a topic."""
        self._count_not_finite(topic, batch)
        for doubt in _find_limits(topic):
            if doubt.field in batch.schema.names:
                size = np.abs(batch[doubt.field].to_numpy(zero_copy_only=False).astype(float))
                size = size[np.isfinite(size) & (size > 0)]
                place = np.floor(np.log2(size) * BINS_PER_OCTAVE).astype(int) + BIN_OF_ONE
                counted = np.bincount(np.clip(place, 0, BIN_COUNT - 1), minlength=BIN_COUNT)
                self.counts[topic, doubt.field] += counted

    def _count_not_finite(self, topic: str, batch: pa.RecordBatch) -> None:
        """Count NaN and infinite values of a sensor's or a pose's fields."""
        if any(parse_topic(pattern, topic) for pattern in FINITE_TOPICS):
            for name, column in _iter_floats(batch):
                bad = ~np.isfinite(column.to_numpy(zero_copy_only=False))
                self.not_finite[topic, name] += int(bad.sum())

    def find_not_finite_fields(self) -> Iterator[tuple[str, str]]:
        """Yield fields with NaN or infinite values."""
        for (topic, name), count in (+self.not_finite).items():
            yield topic, f"{name}: {count} values are not finite"

    def find_implausible_fields(self) -> Iterator[tuple[str, str]]:
        """Yield fields with values too large or too small for their unit."""
        for (topic, name), counts in self.counts.items():
            total = int(counts.sum())
            doubt = next(doubt for doubt in _find_limits(topic) if doubt.field == name)
            beyond = int(counts[_find_bin(doubt.over) + 1 :].sum())
            small = int(counts[: _find_bin(doubt.under)].sum()) if doubt.under else 0
            if total >= MESSAGES_MIN and small * 10 > total * 9:
                yield (
                    topic,
                    f"{name}: {small / total:.0%} of the values are under {doubt.under:g} "
                    f"{doubt.unit}. Was their unit larger than the one that was told?",
                )
            if total >= MESSAGES_MIN and beyond * 10 > total:
                yield (
                    topic,
                    f"{name}: {beyond / total:.0%} of the values are over {doubt.over:g} "
                    f"{doubt.unit}. Are they {doubt.perhaps}?",
                )


def _find_bin(magnitude: float) -> int:
    return int(np.floor(np.log2(magnitude) * BINS_PER_OCTAVE)) + BIN_OF_ONE


def _iter_floats(columns: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the name and values of each float field, also those of nested messages."""
    kind = columns.schema if isinstance(columns, pa.RecordBatch) else columns.type
    for k, one in enumerate(kind):
        column = columns.column(k) if isinstance(columns, pa.RecordBatch) else columns.field(k)
        if pa.types.is_struct(one.type):
            yield from _iter_floats(column, f"{before}{one.name}.")
        elif pa.types.is_floating(one.type):
            yield f"{before}{one.name}", column


def check_units(topic: str, table: pa.Table) -> list[str]:
    """Return the findings about the values of a topic.

    Parameters
    ----------
    topic
        Name of the topic.
    table
        Messages of the topic, with any of the fields that have a limit.
    """
    sizes = MagnitudeHistograms()
    for batch in table.to_batches():
        sizes.add_batch(topic, batch)
    return [text for _, text in sizes.find_implausible_fields()]


def check_periods(times: Mapping[str, Times]) -> Iterator[tuple[str, str]]:
    """Yield sensors whose period is so long or short that their times have the wrong unit."""
    for topic, time_ns in times.items():
        if len(time_ns) < MESSAGES_MIN or not any(
            parse_topic(row.pattern, topic) for row in SENSORS
        ):
            continue
        period_s = float(np.median(np.diff(np.sort(time_ns)))) * 1e-9
        if period_s > PERIOD_MAX_S:
            yield topic, f"one message in {period_s:.3g} s. Were its times in ms, us or ns?"
        elif 0 < period_s < PERIOD_MIN_S:
            yield topic, f"one message in {period_s:.3g} s. Were its times in s, ms or us?"


def _find_limits(topic: str) -> tuple[UnitCheck, ...]:
    return next((row.doubts for row in SENSORS if parse_topic(row.pattern, topic)), ())
