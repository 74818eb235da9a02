"""Protobuf's wire format: find the fields of many messages at once, and decode their values."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from google.protobuf.descriptor import FieldDescriptor
from numpy.typing import NDArray

from dmrl.recording.mcap.message_batch import Bytes, Ints

GATHER_BYTES = 64
"""Mean size of a text below which one gather of all bytes is faster than a slice per text."""

F = FieldDescriptor
FIXED_DTYPES = {
    F.TYPE_DOUBLE: "<f8",
    F.TYPE_FLOAT: "<f4",
    F.TYPE_FIXED64: "<u8",
    F.TYPE_SFIXED64: "<i8",
    F.TYPE_FIXED32: "<u4",
    F.TYPE_SFIXED32: "<i4",
}
VARINT_DTYPES = {
    F.TYPE_INT64: "i8",
    F.TYPE_UINT64: "u8",
    F.TYPE_INT32: "i4",
    F.TYPE_UINT32: "u4",
    F.TYPE_ENUM: "i4",
    F.TYPE_BOOL: "?",
    F.TYPE_SINT32: "i4",
    F.TYPE_SINT64: "i8",
}


VARINT, FIXED64, DELIMITED, START_GROUP, END_GROUP, FIXED32 = range(6)


def find_wire_type(field: FieldDescriptor) -> int:
    """Return the wire type of a field's values, where they are not packed."""
    if field.type in VARINT_DTYPES:
        return VARINT
    if field.type in FIXED_DTYPES:
        return FIXED64 if np.dtype(FIXED_DTYPES[field.type]).itemsize == 8 else FIXED32
    return START_GROUP if field.type == F.TYPE_GROUP else DELIMITED


class WireError(ValueError):
    """The bytes are not messages of the given type."""


def decode_varints(data: Bytes, at: Ints) -> tuple[NDArray[np.uint64], Ints]:
    """Read the varint at each offset; return values and the offsets after them."""
    try:
        byte = data[at]
    except IndexError:
        raise WireError("a value runs beyond its message") from None
    value = (byte & 0x7F).astype(np.uint64)
    at = at + 1
    more = np.flatnonzero(byte & 0x80)
    shift = 7
    while len(more):
        if shift > 63:
            raise WireError("a varint is longer than ten bytes")
        try:
            byte = data[at[more]]
        except IndexError:
            raise WireError("a value runs beyond its message") from None
        value[more] |= (byte & 0x7F).astype(np.uint64) << np.uint64(shift)
        at[more] += 1
        more = more[(byte & 0x80) != 0]
        shift += 7
    return value, at


def decode_present(
    present: NDArray[np.bool_] | None,
    start: Ints,
    read: Callable[[Ints], NDArray[np.generic]],
    dtype: np.dtype[np.generic],
    default: float | None = None,
) -> NDArray[np.generic]:
    """Read the values at ``start``; return the default, or zero, for those that are absent."""
    if present is None or present.all():
        return read(start)
    out = np.full(len(start), default or 0, dtype.newbyteorder("="))
    out[present] = read(start[present])
    return out


def decode_fixed(data: Bytes, at: Ints, dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    """Read (N,) values of fixed size.

    Raises
    ------
    WireError
        If a value reaches beyond the data.
    """
    # A view with a stride of one byte reads unaligned values in one gather.
    view = np.ndarray((max(len(data) - dtype.itemsize + 1, 0),), dtype, data, 0, (1,))
    try:
        return np.ascontiguousarray(view[at])
    except IndexError:
        raise WireError("a value runs beyond its message") from None


def decode_integers(
    data: Bytes, at: Ints, dtype: np.dtype[np.generic], zigzag: bool
) -> NDArray[np.generic]:
    """Read (N,) integers, enums or booleans, stored as varints."""
    value, _ = decode_varints(data, at)
    if zigzag:
        if dtype.itemsize == 4:  # a longer varint is cut first, then decoded
            value &= np.uint64(0xFFFFFFFF)
        value = (value >> np.uint64(1)) ^ (np.uint64(0) - (value & np.uint64(1)))
    return value.astype(np.bool_) if dtype == np.bool_ else value.view(np.int64).astype(dtype)


def decode_strings(data: Bytes, start: Ints, end: Ints, kind: pa.DataType) -> pa.Array:
    """Read (N,) strings or bytes from spans.

    Raises
    ------
    WireError
        If a batch has more than 2 GiB of text.
    UnicodeDecodeError
        If a string is not UTF-8.
    """
    size = end - start
    offsets = np.zeros(len(size) + 1, np.int64)
    np.cumsum(size, out=offsets[1:])
    if offsets[-1] > np.iinfo(np.int32).max:
        raise WireError("more than 2 GiB of text in one batch")
    if len(size) and offsets[-1] > GATHER_BYTES * len(size):
        # An array, since NumPy asks for huge pages: bytes cause a page fault for each 4 kB.
        body = np.empty(offsets[-1], np.uint8)
        view, to = data.data, body.data
        for at, a, b in zip(offsets.tolist(), start.tolist(), end.tolist(), strict=False):
            to[at : at + b - a] = view[a:b]
    else:
        body = data[np.arange(offsets[-1]) + np.repeat(start - offsets[:-1], size)]
    buffers = [None, pa.py_buffer(offsets.astype(np.int32)), pa.py_buffer(body)]
    made = pa.Array.from_buffers(kind, len(size), buffers)
    try:
        made.validate(full=True)
    except pa.ArrowInvalid:
        raise UnicodeDecodeError("utf-8", b"", 0, 0, "in a batch of texts") from None
    return made


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
