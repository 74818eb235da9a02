"""Merge recordings by time, or trim a recording."""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

from dmrl.errors import RecordingError
from dmrl.recording.attachments import copy_extras
from dmrl.recording.copying.chunk_copy import Piece, Wanted, adopt, pieces, put
from dmrl.recording.log_times import log_times
from dmrl.recording.mcap.channel import RawMessage
from dmrl.recording.provenance_inputs import provenance, refuse_twice
from dmrl.recording.reader import matching, read_raw
from dmrl.recording.summary import Summary, summary
from dmrl.recording.writer import RecordingWriter
from dmrl.terminal.progress import say
from dmrl.topics import CALIBRATION, names, row_of


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
    refuse_twice(paths)
    for one, other in combinations(paths, 2):
        _warn_of_namesakes(one, other)
    wanted = [Wanted(frozenset(summary(path).topics)) for path in paths]
    with RecordingWriter(out, provenance("merge", inputs=paths)) as sink:
        for path, every in zip(paths, wanted, strict=True):
            copy_extras(summary(path), sink)
            adopt(path, every.topics, sink)
        streams = [_timed(path, every) for path, every in zip(paths, wanted, strict=True)]
        by_time = heapq.merge(*streams, key=lambda item: item[0])
        return sum(put(piece, every, sink) for _, piece, every in by_time)


def _timed(path: Path, wanted: Wanted) -> Iterator[tuple[int, Piece, Wanted]]:
    """Yield the copy units of a recording with their first log times."""
    return ((piece.start_ns, piece, wanted) for piece in pieces(path, wanted))


def _warn_of_namesakes(one: Path, other: Path) -> None:
    """Warn if two recordings contain the same sensor of a robot.

    They may be different flights or robots. Consecutive parts of one recording do not warn.
    """
    first, second = summary(one), summary(other)
    for topic in sorted(set(first.topics) & set(second.topics)):
        row = row_of(topic)
        if row is None or not row.sensor:
            continue
        (start, end), (from_, to) = (_span(path, topic) for path in (one, other))
        if start < to and from_ < end:
            say(
                f"{one} and {other} both have {topic} at the same time: different flights, or one "
                "made from the other? Their messages are now mixed. dataset and evaluate take "
                "several recordings"
            )
            return
        if not _sources(first) & _sources(second):
            say(
                f"{one} and {other} both have {topic}, one after the other, and are one robot now. "
                "If they are two robots, or two flights, give the robots different names: "
                "dmrl convert --robot"
            )
            return


def _sources(held: Summary) -> set[str]:
    """Return the SHA-256 of every direct and indirect input of a recording."""
    return {source.sha256 for _, source in held.provenance.ancestry()} if held.provenance else set()


def _span(path: Path, topic: str) -> tuple[int, int]:
    """Return the first and last log time of a topic, nanoseconds."""
    times = log_times(path, [topic])[topic]
    return (int(times[0]), int(times[-1])) if len(times) else (0, 0)


def trim(
    path: Path,
    out: Path,
    *,
    start_ns: int | None = None,
    end_ns: int | None = None,
    topics: Sequence[str] = (),
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

    Raises
    ------
    RecordingError
        If the recording is not complete, or no message is in the range.
    OutputError
        If ``out`` exists or cannot be written.
    """
    found = summary(path)
    wanted = matching(path, topics) if topics else frozenset(found.topics)
    settings = {"start_ns": start_ns, "end_ns": end_ns, "topics": list(topics)}
    low = found.start_ns if start_ns is None else max(start_ns, found.start_ns)
    high = found.end_ns + 1 if end_ns is None else end_ns
    with RecordingWriter(out, provenance("trim", settings, [path])) as sink:
        copy_extras(found, sink)
        adopt(path, wanted, sink)
        for raw in _calibrations(path, wanted, low, high):
            sink.write_raw(raw)
        within = Wanted(wanted, low, high)
        count = sum(put(piece, within, sink) for piece in pieces(path, within))
        if not count:
            raise RecordingError(
                f"{path} has no message in that time range; it lasts "
                f"{(found.end_ns - found.start_ns) / 1e9:.3f} s. Choose times within it"
            )
    return count


def _calibrations(
    path: Path, wanted: frozenset[str], low_ns: int, high_ns: int
) -> Iterator[RawMessage]:
    """Yield each camera's last calibration before the range; if all come later, its first."""
    topics = [topic for topic in wanted if names(CALIBRATION, topic) is not None]
    for topic, times in sorted(log_times(path, topics).items()):
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
