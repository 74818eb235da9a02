"""Rewrite a recording with some topics replaced, or with other times."""

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from dmrl.recording.copying import chunk_copy
from dmrl.recording.mcap.channel import RawMessage
from dmrl.recording.mcap.message_batch import MAX_TIME_NS, ROWS_AT_A_TIME, Ints
from dmrl.recording.provenance import Provenance
from dmrl.recording.summary import read_summary
from dmrl.recording.writer import RecordingWriter
from dmrl.samples.sample import Columns, Sample
from dmrl.storage.shared_file import share_file


def rewrite(
    recording: Path,
    out: Path,
    made: Provenance,
    *,
    without: Collection[str],
    fresh: Iterable[Iterable[Sample]] = (),
    series: Sequence[Columns] = (),
    metadata: Mapping[str, dict[str, str]] | None = None,
) -> None:
    """Copy a recording bit for bit without some topics, and add new messages.

    Parameters
    ----------
    recording, out
        Recording to read and recording to write.
    made
        Provenance of ``out``.
    without
        Topics to leave out.
    fresh
        Streams of new messages, each in time order.
    series
        New messages as columns.
    metadata
        Records to add, by name.

    Raises
    ------
    RecordingError
        If the recording cannot be read.
    OutputError
        If ``out`` exists or cannot be written.
    """
    with share_file(recording):
        source = read_summary(recording)
        kept = frozenset(topic for topic in source.topics if topic not in without)
        with RecordingWriter(out, made) as sink:
            sink.copy_extras(source)
            for name, values in (metadata or {}).items():
                sink.add_metadata(name, values)
            chunk_copy.copy_messages(recording, chunk_copy.TopicSelection(kept), sink)
            sink.flush()  # new messages start at the first time again, so they get their own chunks
            for first_ns, end_ns in iter_time_slices([one.time_ns for one in series]):
                for one in series:
                    sink.write_series(one.crop_to_time(first_ns, end_ns))
            for sample in heapq.merge(*fresh, key=lambda sample: sample.time_ns):
                sink.write_sample(sample)


def iter_time_slices(times_ns: Sequence[Ints]) -> Iterator[tuple[int, int]]:
    """Yield time ranges with a bounded number of messages each.

    Readers by time then hold few messages of every topic.

    Parameters
    ----------
    times_ns
        (N,) log times of each topic, nanoseconds.
    """
    times = np.sort(np.concatenate([np.empty(0, np.int64), *times_ns]))
    yield from pairwise([*times[::ROWS_AT_A_TIME].tolist(), MAX_TIME_NS])


def shift_times(
    recording: Path,
    sink: RecordingWriter,
    compute_shift_ns: Callable[[str, Ints], Ints],
    converters: Mapping[str, Callable[[RawMessage], RawMessage]],
) -> None:
    """Copy all messages of a recording with shifted times.

    Parameters
    ----------
    recording, sink
        Recording to read and recording to write.
    compute_shift_ns
        Maps a topic and (N,) log times to the shift of log and publish times, nanoseconds.
    converters
        By topic, a function that converts each message. For messages that contain their time.

    Raises
    ------
    RecordingError
        If the recording cannot be read.
    OutputError
        If the output cannot be written.
    """
    every = chunk_copy.TopicSelection(frozenset(read_summary(recording).topics))
    chunk_copy.adopt_channels(recording, every.topics, sink)
    for unit in chunk_copy.iter_units(recording, every):
        batch = unit.batch
        topics = {n: unit.channels[n].topic for n in batch.list_channel_ids()}
        converted = [number for number, topic in topics.items() if topic in converters]
        shift_ns = np.zeros(len(batch), np.int64)
        for number in topics.keys() - converted:
            rows = batch.channel == number
            shift_ns[rows] = compute_shift_ns(topics[number], batch.time_ns[rows])
        if not converted and not shift_ns.any():
            chunk_copy.write_unit(unit, every, sink)
            continue
        shifted = replace(
            batch,
            time_ns=batch.time_ns + shift_ns,
            publish_ns=np.maximum(batch.publish_ns + shift_ns, 0),
        )
        sink.chunk_writer.append_batch(shifted.take(~batch.mask_channels(converted)), unit.channels)
        for number, time_ns, publish_ns, data in batch.select_channels(converted).iter_rows():
            raw = RawMessage(time_ns, publish_ns, unit.channels[number], data)
            sink.write_raw(converters[raw.topic](raw))
