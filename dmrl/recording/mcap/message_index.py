"""Build and parse Message Index records: offsets and times of a chunk's messages by channel."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode

from dmrl.recording.mcap.file import damaged
from dmrl.recording.mcap.message_batch import HEAD_BYTES, Block, Bytes, Ints, put_at, taken

INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries
ENTRY_BYTES = 16  # log time, offset
_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("size", "<u4")])
_ENTRY = np.dtype([("time", "<i8"), ("at", "<i8")])


@dataclass(frozen=True, slots=True)
class MessageIndex:
    """The Message Index records of a chunk.

    They contain no file offsets, so a copied chunk keeps them unchanged.

    Parameters
    ----------
    records
        Contiguous records, one for each channel.
    offsets
        Offset of each record in ``records``, by channel id.
    counts
        Number of messages, by channel id.
    """

    records: bytes
    places: dict[int, int]
    counts: dict[int, int]


def index_of(block: Block) -> MessageIndex:
    """Build the message indexes of a chunk that holds these messages."""
    counts = np.bincount(block.channel)
    numbers = np.flatnonzero(counts)
    counts = counts[numbers]
    ends = INDEX.size * np.arange(1, len(numbers) + 1) + ENTRY_BYTES * np.cumsum(counts)
    starts = ends - ENTRY_BYTES * counts - INDEX.size
    records: Bytes = np.empty(int(ends[-1]), np.uint8)
    heads = np.empty(len(numbers), _HEAD)
    heads["opcode"], heads["channel"] = Opcode.MESSAGE_INDEX, numbers
    heads["size"] = ENTRY_BYTES * counts
    heads["length"] = heads["size"] + 6
    put_at(records, starts, heads)
    # NumPy uses a radix sort for 16-bit integers.
    order = np.argsort(block.channel.astype(np.uint16), kind="stable")
    entries = np.empty(len(block), _ENTRY)
    entries["time"] = block.time_ns[order]
    entries["at"] = block.start[order] - HEAD_BYTES
    put_at(records, _places_of_entries(starts, counts), entries)
    places = zip(numbers.tolist(), starts.tolist(), strict=True)
    found = zip(numbers.tolist(), counts.tolist(), strict=True)
    return MessageIndex(records.tobytes(), dict(places), dict(found))


def indexes_size(counts: Mapping[int, int]) -> int:
    """Return the total size of message indexes from the message counts by channel, bytes."""
    return INDEX.size * len(counts) + ENTRY_BYTES * sum(counts.values())


def _places_of_entries(starts: Ints, counts: Ints) -> Ints:
    """Return the offset of every entry of records with these offsets and entry counts."""
    first = starts + INDEX.size - ENTRY_BYTES * (np.cumsum(counts) - counts)
    found: Ints = np.repeat(first, counts) + ENTRY_BYTES * np.arange(counts.sum())
    return found


class Entries(NamedTuple):
    """Entries of the message indexes of a chunk, channel by channel.

    Parameters
    ----------
    channel, time_ns, offset
        (N,) channel id and log time of each message, and the offset of its record in the chunk.
    counts
        (C,) number of messages of each channel.
    """

    channel: Ints
    time_ns: Ints
    at: Ints
    counts: Ints


def index_entries(path: Path, raw: bytes, places: Mapping[int, int]) -> Entries:
    """Parse the message indexes of some channels.

    Parameters
    ----------
    path
        The recording, for errors.
    raw
        Bytes that contain the records.
    offsets
        Offset of each record in ``raw``, by channel id.

    Raises
    ------
    RecordingError
        If a record is truncated, or is not the Message Index of its channel.
    """
    numbers = np.fromiter(places.keys(), np.int64, len(places))
    at = np.fromiter(places.values(), np.int64, len(places))
    if len(at) and not 0 <= at.min() <= at.max() <= len(raw) - INDEX.size:
        raise damaged(path, "a message index is cut")
    heads = taken(raw, _HEAD, at)
    size = heads["size"].astype(np.int64)
    right = (heads["opcode"] == Opcode.MESSAGE_INDEX) & (heads["channel"] == numbers)
    right &= (heads["length"] == size + 6) & (size % ENTRY_BYTES == 0)
    if not right.all():
        raise damaged(path, f"message index of channel {numbers[~right][0]} is wrong")
    if (at + INDEX.size + size > len(raw)).any():
        raise damaged(path, "a message index is cut")
    counts = size // ENTRY_BYTES
    entries = taken(raw, _ENTRY, _places_of_entries(at, counts))
    return Entries(np.repeat(numbers, counts), entries["time"], entries["at"], counts)
