"""Compare messages read by Google's library with rows of dmrl's tables, in one plain form."""

import json
from typing import Any

import numpy as np
from google.protobuf import json_format
from google.protobuf.descriptor import Descriptor, FieldDescriptor

from dmrl.recording.protobuf.decode import decode


def decode_rows(parts: list[bytes], kind: Descriptor) -> list[dict[str, Any]]:
    """Decode serialized messages in bulk and return a dictionary for each."""
    end = np.cumsum([len(p) for p in parts], dtype=np.int64)
    start = end - np.array([len(p) for p in parts], np.int64)
    got = decode(np.frombuffer(b"".join(parts), np.uint8), start, end, kind)
    for column in got.values():
        column.validate(full=True)
    lists = {name: column.to_pylist() for name, column in got.items()}
    return [{name: lists[name][k] for name in lists} for k in range(len(parts))]


def contains_itself(kind: Descriptor, within: tuple[str, ...] = ()) -> bool:
    """Return whether a type contains a recursive type at any depth, itself included."""
    if kind.full_name in within:
        return True
    inner = (f.message_type for f in kind.fields if f.message_type is not None)
    return any(contains_itself(one, (*within, kind.full_name)) for one in inner)


def parse_sorted_json(text: str) -> Any:
    """Parse a JSON text and sort the keys of its objects, since maps have no order."""
    return json.loads(text, object_pairs_hook=lambda pairs: dict(sorted(pairs)))


def read_row(message: Any, *, top: bool = True) -> Any:
    """Return a message as the table has it, read by Google's own library."""
    kind = message.DESCRIPTOR
    if not top and contains_itself(kind):
        return parse_sorted_json(
            json_format.MessageToJson(
                message, preserving_proto_field_name=True, descriptor_pool=kind.file.pool
            )
        )
    out = {field.name: _value(message, field) for field in kind.fields}
    for extension in sorted(kind.file.pool.FindAllExtensions(kind), key=lambda f: f.number):
        held = message.Extensions[extension]
        out[f"[{extension.full_name}]"] = list(held) if extension.is_repeated else held
    return out


def _value(message: Any, field: FieldDescriptor) -> Any:
    """Return the value of a field as the table has it."""
    held, inner = getattr(message, field.name), field.message_type
    if inner is not None and inner.GetOptions().map_entry:
        entries = [
            (key, held[key] if inner.fields_by_name["value"].message_type is None else
             read_row(held[key], top=False))
            for key in held
        ]  # fmt: skip
        return sorted(entries, key=repr)
    if field.is_repeated:
        return [read_row(one, top=False) if inner is not None else one for one in held]
    if inner is not None:
        return read_row(held, top=False) if message.HasField(field.name) else None
    return held


def from_table(value: Any, kind: Descriptor, *, top: bool = True) -> Any:
    """Return a row of a table in the form of `read_row`: maps sorted, JSON parsed."""
    if value is None:
        return None
    if not top and contains_itself(kind):
        return parse_sorted_json(value)
    out = dict(value)
    for field in kind.fields:
        inner = field.message_type
        if inner is None:
            continue
        if inner.GetOptions().map_entry:
            deep = inner.fields_by_name["value"].message_type
            out[field.name] = sorted(
                (
                    (one["key"], from_table(one["value"], deep, top=False))
                    if deep is not None
                    else (one["key"], one["value"])
                    for one in value[field.name]
                ),
                key=repr,
            )
        elif field.is_repeated:
            out[field.name] = [from_table(one, inner, top=False) for one in value[field.name]]
        else:
            out[field.name] = from_table(value[field.name], inner, top=False)
    return out
