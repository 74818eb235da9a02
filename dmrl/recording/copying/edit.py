"""Merge recordings by time, or trim a recording."""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

from dmrl.errors import RecordingError
from dmrl.recording.copying import chunk_copy
from dmrl.recording.log_times import read_log_times, read_time_spans
from dmrl.recording.mcap.channel import RawMessage
from dmrl.recording.mcap.extra_records import read_header
from dmrl.recording.mcap.file import open_mcap
from dmrl.recording.mcap.message_batch import MAX_TIME_NS
from dmrl.recording.protobuf.message_types import carries_own_type
from dmrl.recording.provenance import Provenance
from dmrl.recording.provenance_inputs import build_provenance, refuse_duplicates
from dmrl.recording.reader import read_raw, select_topics
from dmrl.recording.summary import Summary, read_summary
from dmrl.recording.writer import RecordingWriter
from dmrl.terminal.progress import say
from dmrl.topics import CALIBRATION, find_topic, parse_topic


def merge(paths: Sequence[Path], out: Path) -> int:
    """Merge recordings by log time into one, and return the number of messages.

    Messages are copied bit for bit, chunk by chunk. Metadata and attachments of all are kept.
    A warning is printed if two recordings contain the same robot's sensor.

    Raises
    ------
    RecordingError
        If an input is not a complete recording, or is given twice.
    OutputError
        If ``out`` exists or cannot be written.
    """
    refuse_duplicates(paths)
    for one, other in combinations(paths, 2):
        _warn_about_shared_sensors(one, other)
    wanted = [chunk_copy.TopicSelection(frozenset(read_summary(path).topics)) for path in paths]
    with RecordingWriter(out, build_provenance("merge", inputs=paths)) as sink:
        for path, every in zip(paths, wanted, strict=True):
            sink.copy_extras(read_summary(path))
            chunk_copy.adopt_channels(path, every.topics, sink)
        streams = [
            _iter_timed_units(path, every) for path, every in zip(paths, wanted, strict=True)
        ]
        by_time = heapq.merge(*streams, key=lambda item: item[0])
        return sum(chunk_copy.write_unit(piece, every, sink) for _, piece, every in by_time)


def _iter_timed_units(
    path: Path, wanted: chunk_copy.TopicSelection
) -> Iterator[tuple[int, chunk_copy.CopyUnit, chunk_copy.TopicSelection]]:
    """Yield the copy units of a recording with their first log times."""
    return ((piece.start_ns, piece, wanted) for piece in chunk_copy.iter_units(path, wanted))


def _warn_about_shared_sensors(one: Path, other: Path) -> None:
    """Warn if two recordings contain the same sensor of a robot.

    They may be different flights or robots. Consecutive parts of one recording do not warn.
    """
    first, second = read_summary(one), read_summary(other)
    rows = {topic: find_topic(topic) for topic in sorted({*first.topics} & {*second.topics})}
    shared = [topic for topic, row in rows.items() if row is not None and row.sensor]
    spans = [read_time_spans(path) for path in (one, other)] if shared else []
    for topic in shared:
        if not all(topic in found for found in spans):
            continue  # one of them has no message on it
        (start, end), (from_, to) = (found[topic] for found in spans)
        if start < to and from_ < end:
            say(
                f"{one} and {other} both have {topic} at the same time: different flights, or one "
                "made from the other? Their messages are now mixed. dataset and evaluate take "
                "several recordings"
            )
            return
        if not _collect_source_hashes(first) & _collect_source_hashes(second):
            say(
                f"{one} and {other} both have {topic}, one after the other, and are one robot now. "
                "If they are two robots, or two flights, give the robots different names: "
                "dmrl convert --robot"
            )
            return


def _collect_source_hashes(summary: Summary) -> set[str]:
    """Return the SHA-256 of every direct and indirect input of a recording."""
    made = summary.provenance
    return {source.sha256 for _, source in made.iter_ancestors()} if made else set()


def trim(
    path: Path,
    out: Path,
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
    topics: Sequence[str] = (),
    origin: Provenance | None = None,
) -> int:
    """Write the messages of a time range, or of some topics, and return how many.

    The camera calibration valid at the start is kept as the first message of the range. The output
    stays usable, and its time counts from the start of the range.

    Parameters
    ----------
    path, out
        Recording to read and recording to write.
    start_ns, end_ns
        Log times to keep, in [start_ns, end_ns), nanoseconds.
    topics
        Topics or patterns to keep. Empty: all.
    origin
        Provenance of ``out``. None: it has the settings above.

    Raises
    ------
    RecordingError
        If the recording is not complete, or no message is in the range.
    OutputError
        If ``out`` exists or cannot be written.
    """
    source = read_summary(path)
    topics_to_keep = frozenset(source.topics)
    if topics:
        topics_to_keep = select_topics(path, source.topics, topics)
    if origin is None:
        settings = {"start_ns": start_ns, "end_ns": end_ns, "topics": list(topics)}
        origin = build_provenance("trim", settings, [path])
    low = source.start_ns if start_ns is None else max(start_ns, source.start_ns)
    high = MAX_TIME_NS if end_ns is None else end_ns
    with open_mcap(path) as stream:
        profile = read_header(stream).profile
    with RecordingWriter(out, origin, profile=profile) as sink:
        sink.copy_extras(source)
        chunk_copy.adopt_channels(path, topics_to_keep, sink)
        typed = frozenset(t for t in topics_to_keep if carries_own_type(t, source.topics[t].schema))
        calibrations = list(_iter_calibrations(path, typed, low, high))
        for raw in calibrations:
            sink.write_raw(raw)
        selection = chunk_copy.TopicSelection(topics_to_keep, start_ns or 0, high)
        count = sum(
            chunk_copy.write_unit(piece, selection, sink)
            for piece in chunk_copy.iter_units(path, selection)
        )
        if not count and source.count:
            raise _describe_nothing(path, source, topics_to_keep)
    return count + len(calibrations)


def _describe_nothing(path: Path, source: Summary, kept: frozenset[str]) -> RecordingError:
    """Return the error of a range, or of topics, without a message."""
    if not any(source.topics[topic].count for topic in kept):
        names = ", ".join(sorted(kept))
        return RecordingError(f"{path} has no message on {names}. Keep other topics too")
    return RecordingError(
        f"{path} has no message in that time range; it lasts "
        f"{(source.end_ns - source.start_ns) / 1e9:.3f} s. Choose times within it"
    )


def _iter_calibrations(
    path: Path, wanted: frozenset[str], low_ns: int, high_ns: int
) -> Iterator[RawMessage]:
    """Yield each camera's last calibration before the range; if all come later, its first."""
    topics = [topic for topic in wanted if parse_topic(CALIBRATION, topic) is not None]
    for topic, times in sorted(read_log_times(path, topics).items()):
        earlier = times[times <= low_ns]
        later = times[times >= high_ns]
        if len(earlier):
            at_ns = int(earlier[-1])
        elif len(later) == len(times) > 0:
            at_ns = int(later[0])
        else:
            continue
        if at_ns != low_ns:  # else it is in the range
            *_, raw = read_raw(path, topic, start_ns=at_ns, end_ns=at_ns + 1)
            yield replace(raw, time_ns=low_ns)
