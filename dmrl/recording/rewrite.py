"""A recording written again, with some topics in place of those it had."""

import heapq
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from dmrl.recording.copying import Wanted, copy
from dmrl.recording.extras import copy_extras
from dmrl.recording.index import summary
from dmrl.recording.provenance import Provenance
from dmrl.recording.writer import RecordingWriter


class Timed(NamedTuple):
    """A message to write at a log time."""

    time_ns: int
    topic: str
    message: Any


def rewrite(
    recording: Path,
    out: Path,
    made: Provenance,
    *,
    without: Collection[str],
    fresh: Iterable[Iterable[Timed]],
    metadata: Mapping[str, dict[str, str]] | None = None,
) -> None:
    """Copy a recording bit for bit, but for some topics, and add new messages.

    Parameters
    ----------
    recording, out
        Recording to read and recording to write.
    made
        Provenance of ``out``.
    without
        Topics that are left out.
    fresh
        Streams of new messages, each in time order.
    metadata
        Records to add, by name.

    Raises
    ------
    RecordingError
        If the recording cannot be read.
    OutputError
        If ``out`` exists or cannot be written.
    """
    held = summary(recording)
    kept = frozenset(topic for topic in held.topics if topic not in without)
    with RecordingWriter(out, made) as sink:
        copy_extras(held, sink)
        for name, values in (metadata or {}).items():
            sink.add_metadata(name, values)
        copy(recording, Wanted(kept), sink)
        sink.flush()  # what is new begins at the start again: it gets chunks of its own
        for item in heapq.merge(*fresh, key=lambda m: m.time_ns):
            sink.write(*item)
