"""Find the fields of protobuf messages in their bytes, thousands of messages at a time.

Every round reads the next tag of every message, groups the messages by tag, and skips the values.
Source: Protocol Buffers encoding specification.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dmrl.recording.mcap.message_batch import Bytes, Ints
from dmrl.recording.protobuf.wire_values import (
    DELIMITED,
    END_GROUP,
    FIXED32,
    FIXED64,
    START_GROUP,
    VARINT,
    WireError,
    decode_varints,
)

MAX_DEPTH = 100
"""Nesting of messages, the limit of Google's own decoders."""


@dataclass(frozen=True, slots=True)
class FieldSpans:
    """Occurrences of one field: row and byte range of each value.

    For varints ``start`` is the first byte of the value, for delimited values and groups that of
    the payload.
    """

    row: Ints
    wire: int
    start: Ints
    end: Ints


def find_fields(
    data: Bytes, start: Ints, end: Ints, wanted: set[int]
) -> dict[int, list[FieldSpans]]:
    """Find the wanted fields of every message, in wire order within a message.

    Raises
    ------
    WireError
        If the bytes do not conform to the wire format.
    """
    found: dict[int, list[FieldSpans]] = {}
    row, at, end = np.arange(len(start)), start.copy(), np.asarray(end)
    while True:
        going = at < end
        if not going.all():
            if (at > end).any():
                raise WireError("a value runs beyond its message")
            row, at, end = row[going], at[going], end[going]
        if not len(row):
            return found
        tag, at = decode_varints(data, at)
        if (tag == tag[0]).all():
            at = _record_field(data, int(tag[0]), row, at, wanted, found)
            continue
        for one in np.unique(tag):
            these = np.flatnonzero(tag == one)
            at[these] = _record_field(data, int(one), row[these], at[these], wanted, found)


def _record_field(
    data: Bytes, tag: int, row: Ints, at: Ints, wanted: set[int], found: dict[int, list[FieldSpans]]
) -> Ints:
    """Record one field of some messages; return the offset of each message's next field."""
    first, last, after = _locate_value(data, tag, at, 0)
    if tag >> 3 in wanted:
        found.setdefault(tag >> 3, []).append(FieldSpans(row, tag & 7, first, last))
    return after


def _locate_value(data: Bytes, tag: int, at: Ints, depth: int) -> tuple[Ints, Ints, Ints]:
    """Return the first byte of each value of a tag, its end, and the offset of the next field."""
    number, wire = tag >> 3, tag & 7
    if not number:
        raise WireError("a field has number 0")
    if wire == VARINT:
        _, after = decode_varints(data, at)
    elif wire == FIXED64:
        after = at + 8
    elif wire == FIXED32:
        after = at + 4
    elif wire == DELIMITED:
        size, first = decode_varints(data, at)
        after = first + size.astype(np.int64)
        if (after < first).any():
            raise WireError("a length is negative")
        return first, after, after
    elif wire == START_GROUP:
        return at, *_skip_groups(data, number, at, depth + 1)
    else:
        raise WireError(f"field {number} has wire type {wire}, which cannot begin a value")
    return at, after, after


def _skip_groups(data: Bytes, number: int, start: Ints, depth: int) -> tuple[Ints, Ints]:
    """Return the offset of the end tag of each group, and the offset after that tag."""
    if depth > MAX_DEPTH:
        raise WireError("groups are nested too deep")
    at, end, going = start.copy(), start.copy(), np.arange(len(start))
    while len(going):
        end[going] = at[going]
        tag, at[going] = decode_varints(data, at[going])
        going, tag = going[tag != (number << 3 | END_GROUP)], tag[tag != (number << 3 | END_GROUP)]
        for one in np.unique(tag):
            these = going[tag == one]
            at[these] = _locate_value(data, int(one), at[these], depth)[2]
        if (at > len(data)).any():
            raise WireError("a value runs beyond its message")
    return end, at


def concatenate_spans(parts: Iterable[Ints]) -> Ints:
    """Concatenate rows or offsets of several spans."""
    return np.concatenate([np.empty(0, np.int64), *parts])
