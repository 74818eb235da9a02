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
from dmrl.recording.protobuf.decode import DELIMITED, FIXED32, FIXED64, VARINT
from dmrl.recording.protobuf.wire_values import FIXED, VARINTS

Value = ArrayLike | Mapping[str, "Value"]
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
    kind: Descriptor, fields: Mapping[str, Value], count: int, head_bytes: int = 0
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
    cells = _message(kind, fields, count)
    if head_bytes:
        cells = _side_by_side([_constant(bytes(head_bytes), count), cells], count)
    ends = np.concatenate([[0], np.cumsum(cells.there.sum(axis=1))])
    return cells.data[cells.there], ends


def _message(kind: Descriptor, fields: Mapping[str, Value], count: int) -> Cells:
    known = kind.fields_by_name
    if unknown := [name for name in fields if name not in known]:
        raise ValueError(f"{kind.full_name} has no field {unknown[0]}")
    chosen = sorted((known[name] for name in fields), key=lambda field: int(field.number))
    return _side_by_side([_field(field, fields[field.name], count) for field in chosen], count)


def _side_by_side(parts: Sequence[Cells], count: int) -> Cells:
    nothing = np.empty((count, 0), np.uint8)
    return Cells(
        np.concatenate([nothing, *(part.data for part in parts)], axis=1),
        np.concatenate([nothing.astype(bool), *(part.there for part in parts)], axis=1),
    )


def _field(field: FieldDescriptor, value: Value, count: int) -> Cells:
    if field.type == F.TYPE_MESSAGE:
        if field.is_repeated or not isinstance(value, Mapping) or field.message_type is None:
            raise TypeError(f"{field.full_name} needs a mapping of columns for its sub-message")
        body = _message(field.message_type, value, count)
        return _delimited(field, body, np.ones(count, bool))
    if field.type in (F.TYPE_STRING, F.TYPE_BYTES):
        return _text(field, value, count)
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{field.full_name} takes numbers")
    if field.is_repeated:
        body = _repeated(field, array, count)
        return _delimited(field, body, np.asarray(body.there.any(axis=1)))
    body, zero = _scalar(field, np.broadcast_to(array, count))
    cells = _side_by_side([_constant(_tag(field, _wire(field)), count), body], count)
    return cells._replace(there=cells.there & ~zero[:, None])


def _scalar(field: FieldDescriptor, array: NDArray[np.generic]) -> tuple[Cells, Mask]:
    """Encode the values of a field, and return which of them are its default."""
    if field.type in FIXED:
        values = np.ascontiguousarray(array, dtype=FIXED[field.type])
        data = values.view(np.uint8).reshape(len(values), -1)
        # As in protobuf, -0.0 is not the default.
        return Cells(data, np.ones(data.shape, bool)), ~np.asarray(data.any(axis=1))
    if field.type not in VARINTS:
        raise TypeError(f"{field.full_name} has a type that cannot be written from columns")
    with np.errstate(invalid="ignore"):  # NaN is rejected below
        values = array.astype(VARINTS[field.type])
    if not np.array_equal(values, array):
        raise ValueError(f"{field.full_name} takes integers within its range")
    signed = values.astype(np.int64)
    if field.type in (F.TYPE_SINT32, F.TYPE_SINT64):
        signed = (signed << 1) ^ (signed >> 63)
    bits = signed.view(np.uint64)
    return _varint(bits), bits == 0


def _repeated(field: FieldDescriptor, array: NDArray[np.generic], count: int) -> Cells:
    """Encode a packed repeated field from (N, K) values."""
    if field.type not in FIXED or array.ndim != 2 or len(array) != count:
        raise ValueError(f"{field.full_name} takes {count} rows of numbers of fixed size")
    values = np.ascontiguousarray(array, dtype=FIXED[field.type])
    data = values.view(np.uint8).reshape(count, -1)
    return Cells(data, np.ones(data.shape, bool))


def _text(field: FieldDescriptor, value: Value, count: int) -> Cells:
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
    return _delimited(field, body, size > 0)


def _delimited(field: FieldDescriptor, body: Cells, there: Mask) -> Cells:
    """Put the tag and length of a field before its payloads."""
    size = _varint(body.there.sum(axis=1).astype(np.uint64))
    cells = _side_by_side([_constant(_tag(field, DELIMITED), len(there)), size, body], len(there))
    return cells._replace(there=cells.there & there[:, None])


def _wire(field: FieldDescriptor) -> int:
    if field.type in FIXED:
        return FIXED64 if np.dtype(FIXED[field.type]).itemsize == 8 else FIXED32
    return VARINT


def _tag(field: FieldDescriptor, wire: int) -> bytes:
    cells = _varint(np.array([field.number << 3 | wire], np.uint64))
    return cells.data[cells.there].tobytes()


def _constant(text: bytes, count: int) -> Cells:
    data = np.broadcast_to(np.frombuffer(text, np.uint8), (count, len(text)))
    return Cells(data, np.ones(data.shape, bool))


def _varint(values: NDArray[np.uint64]) -> Cells:
    most = int(values.max(initial=0)).bit_length()
    width = max(1, -(-most // 7))
    shifted = values[:, None] >> (np.arange(width, dtype=np.uint64) * np.uint64(7))
    there = shifted > 0
    there[:, 0] = True
    more = np.zeros_like(there)
    more[:, :-1] = there[:, 1:]
    data = (shifted & np.uint64(0x7F)).astype(np.uint8) | (more * np.uint8(0x80))
    return Cells(data, there)
