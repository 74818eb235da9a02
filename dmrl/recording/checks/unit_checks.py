"""Check whether the values of a recording are in the units of their topics.

Magnitudes are counted in logarithmic bins as messages pass, so that memory is constant.
Findings are topic and text.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dmrl.topics import SENSORS, UnitCheck, parse_topic

PERIOD_MAX_S, PERIOD_MIN_S = 5.0, 1e-5
"""Longest and shortest plausible median period of a sensor, seconds."""
MESSAGES_MIN = 20
"""Messages needed to measure a period or a magnitude."""
BINS_PER_OCTAVE = 4
"""Bins per power of two."""
BIN_COUNT, BIN_OF_ONE = 2048, 1024
"""Number of bins, and the bin of magnitude 1."""
Times = NDArray[np.int64]


@dataclass(slots=True)
class MagnitudeHistograms:
    """Histograms of the magnitudes of sensor values, by topic and field, in logarithmic bins."""

    counts: dict[tuple[str, str], NDArray[np.int64]] = field(
        default_factory=lambda: defaultdict(lambda: np.zeros(BIN_COUNT, np.int64))
    )

    def add_batch(self, topic: str, batch: pa.RecordBatch) -> None:
        """Add the values of a topic."""
        for doubt in _find_limits(topic):
            if doubt.field in batch.schema.names:
                size = np.abs(batch[doubt.field].to_numpy(zero_copy_only=False).astype(float))
                size = size[np.isfinite(size) & (size > 0)]
                place = np.floor(np.log2(size) * BINS_PER_OCTAVE).astype(int) + BIN_OF_ONE
                counted = np.bincount(np.clip(place, 0, BIN_COUNT - 1), minlength=BIN_COUNT)
                self.counts[topic, doubt.field] += counted

    def find_implausible_fields(self) -> Iterator[tuple[str, str]]:
        """Yield fields of which over a tenth of the values exceed the limit for their unit."""
        for (topic, name), counts in self.counts.items():
            total = int(counts.sum())
            doubt = next(doubt for doubt in _find_limits(topic) if doubt.field == name)
            beyond = int(
                counts[
                    int(np.floor(np.log2(doubt.over) * BINS_PER_OCTAVE)) + BIN_OF_ONE + 1 :
                ].sum()
            )
            if total >= MESSAGES_MIN and beyond * 10 > total:
                yield (
                    topic,
                    f"{name}: {beyond / total:.0%} of the values are over {doubt.over:g} "
                    f"{doubt.unit}. Are they {doubt.perhaps}?",
                )


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
