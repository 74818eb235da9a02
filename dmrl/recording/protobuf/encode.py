"""Encode columns to protobuf messages, thousands at a time; the inverse of `decode`.

Every field becomes a byte matrix with one row per message, and a mask of the bytes in use: a
zero value is omitted, and a varint has its minimal length. The matrices side by side, read along
the rows, are the messages. The bytes equal those of the protobuf package.
Source: Protocol Buffers encoding specification.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from numpy.typing import ArrayLike, NDArray

from dmrl.recording.mcap.message_batch import Bytes, Ints
from dmrl.recording.protobuf import wire_format

ColumnValue = ArrayLike | Mapping[str, "ColumnValue"]
"""Values of a field.

A column (N,), or (N, K) for a repeated field; a single value for all messages; for a sub-message,
its fields by name.
"""
Mask = NDArray[np.bool_]
F = FieldDescriptor


class Cells(NamedTuple):
    """(N, W) bytes, and a mask of those in use."""

    data: Bytes
    there: Mask


def encode(
    kind: Descriptor, fields: Mapping[str, ColumnValue], count: int, prefix_bytes: int = 0
) -> tuple[Bytes, Ints]:
    """Encode columns to messages.

    Parameters
    ----------
    kind
        Message type.
    fields
        Columns by field name. Missing fields have their default.
    count
        Number of messages, N.
    prefix_bytes
        Zeros to leave before each message.

    Returns
    -------
    tuple
        Contiguous messages, and (N + 1,) offset of each with its prefix, and the end of the last.

    Raises
    ------
    TypeError, ValueError
        If the type lacks a field, or a column has another type or length than the field needs.
    """
    cells = _encode_message(kind, fields, count)
    if prefix_bytes:
        cells = _concatenate_cells([_repeat_bytes(bytes(prefix_bytes), count), cells], count)
    ends = np.concatenate([[0], np.cumsum(cells.there.sum(axis=1))])
    return cells.data[cells.there], ends


def _encode_message(kind: Descriptor, fields: Mapping[str, ColumnValue], count: int) -> Cells:
    known = kind.fields_by_name
    if unknown := [name for name in fields if name not in known]:
        raise ValueError(f"{kind.full_name} has no field {unknown[0]}")
    chosen = sorted((known[name] for name in fields), key=lambda field: int(field.number))
    return _concatenate_cells(
        [_encode_field(field, fields[field.name], count) for field in chosen], count
    )


def _concatenate_cells(parts: Sequence[Cells], count: int) -> Cells:
    nothing = np.empty((count, 0), np.uint8)
    return Cells(
        np.concatenate([nothing, *(part.data for part in parts)], axis=1),
        np.concatenate([nothing.astype(bool), *(part.there for part in parts)], axis=1),
    )


def _encode_field(field: FieldDescriptor, value: ColumnValue, count: int) -> Cells:
    if field.type == F.TYPE_MESSAGE:
        if field.is_repeated or not isinstance(value, Mapping) or field.message_type is None:
            raise TypeError(f"{field.full_name} needs a mapping of columns for its sub-message")
        body = _encode_message(field.message_type, value, count)
        return _encode_delimited(field, body, np.ones(count, bool))
    if field.type in (F.TYPE_STRING, F.TYPE_BYTES):
        return _encode_text(field, value, count)
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{field.full_name} takes numbers")
    if field.is_repeated:
        body = _encode_repeated(field, array, count)
        return _encode_delimited(field, body, np.asarray(body.there.any(axis=1)))
    body, zero = _encode_scalar(field, np.broadcast_to(array, count))
    cells = _concatenate_cells(
        [_repeat_bytes(_encode_tag(field, wire_format.find_wire_type(field)), count), body], count
    )
    return cells._replace(there=cells.there & ~zero[:, None])


def _encode_scalar(field: FieldDescriptor, array: NDArray[np.generic]) -> tuple[Cells, Mask]:
    """Encode the values of a field, and return which of them are its default."""
    if field.type in wire_format.FIXED_DTYPES:
        values = np.ascontiguousarray(array, dtype=wire_format.FIXED_DTYPES[field.type])
        data = values.view(np.uint8).reshape(len(values), -1)
        # As in protobuf, -0.0 is not the default.
        return Cells(data, np.ones(data.shape, bool)), ~np.asarray(data.any(axis=1))
    if field.type not in wire_format.VARINT_DTYPES:
        raise TypeError(f"{field.full_name} has a type that cannot be written from columns")
    with np.errstate(invalid="ignore"):  # NaN is rejected below
        values = array.astype(wire_format.VARINT_DTYPES[field.type])
    if not np.array_equal(values, array):
        raise ValueError(f"{field.full_name} takes integers within its range")
    signed = values.astype(np.int64)
    if field.type in (F.TYPE_SINT32, F.TYPE_SINT64):
        signed = (signed << 1) ^ (signed >> 63)
    bits = signed.view(np.uint64)
    return _encode_varint(bits), bits == 0


def _encode_repeated(field: FieldDescriptor, array: NDArray[np.generic], count: int) -> Cells:
    """Encode a packed repeated field from (N, K) values."""
    if field.type not in wire_format.FIXED_DTYPES or array.ndim != 2 or len(array) != count:
        raise ValueError(f"{field.full_name} takes {count} rows of numbers of fixed size")
    values = np.ascontiguousarray(array, dtype=wire_format.FIXED_DTYPES[field.type])
    data = values.view(np.uint8).reshape(count, -1)
    return Cells(data, np.ones(data.shape, bool))


def _encode_text(field: FieldDescriptor, value: ColumnValue, count: int) -> Cells:
    """Encode texts or bytes: one for all messages, or one for each."""
    if isinstance(value, Mapping):
        raise TypeError(f"{field.full_name} takes a text")
    texts = [value] * count if isinstance(value, str | bytes) else list(np.asarray(value, object))
    if len(texts) != count or field.is_repeated:
        raise ValueError(f"{field.full_name} takes one text, or {count} of them")
    if not all(isinstance(text, str if field.type == F.TYPE_STRING else bytes) for text in texts):
        raise TypeError(
            f"{field.full_name} takes {'text' if field.type == F.TYPE_STRING else 'bytes'}"
        )
    parts = [text.encode() if isinstance(text, str) else bytes(text) for text in texts]
    size = np.array([len(part) for part in parts], np.int64)
    width = int(size.max(initial=0))
    data = np.frombuffer(b"".join(part.ljust(width, b"\0") for part in parts), np.uint8)
    body = Cells(data.reshape(count, width), np.arange(width) < size[:, None])
    return _encode_delimited(field, body, size > 0)


def _encode_delimited(field: FieldDescriptor, body: Cells, there: Mask) -> Cells:
    """Put the tag and length of a field before its payloads."""
    size = _encode_varint(body.there.sum(axis=1).astype(np.uint64))
    cells = _concatenate_cells(
        [_repeat_bytes(_encode_tag(field, wire_format.DELIMITED), len(there)), size, body],
        len(there),
    )
    return cells._replace(there=cells.there & there[:, None])


def _encode_tag(field: FieldDescriptor, wire: int) -> bytes:
    cells = _encode_varint(np.array([field.number << 3 | wire], np.uint64))
    return cells.data[cells.there].tobytes()


def _repeat_bytes(text: bytes, count: int) -> Cells:
    data = np.broadcast_to(np.frombuffer(text, np.uint8), (count, len(text)))
    return Cells(data, np.ones(data.shape, bool))


def _encode_varint(values: NDArray[np.uint64]) -> Cells:
    most = int(values.max(initial=0)).bit_length()
    width = max(1, -(-most // 7))
    shifted = values[:, None] >> (np.arange(width, dtype=np.uint64) * np.uint64(7))
    there = shifted > 0
    there[:, 0] = True
    more = np.zeros_like(there)
    more[:, :-1] = there[:, 1:]
    data = (shifted & np.uint64(0x7F)).astype(np.uint8) | (more * np.uint8(0x80))
    return Cells(data, there)
