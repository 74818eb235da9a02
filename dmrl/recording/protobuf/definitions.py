"""Build message types from the schema of a recording, as any writer may have written it.

Files may come in any order, twice, or without their imports. Google's own files and those of dmrl
are taken from the installed packages where a recording lacks them. A field whose type is defined
nowhere keeps its wire format: a sub-message becomes bytes, an enum an integer.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from importlib import import_module

from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool

from dmrl.messages import PACKAGES, find_descriptor

F = FieldDescriptorProto
WELL_KNOWN_FILES = (
    "any api descriptor duration empty field_mask source_context struct timestamp type wrappers"
)
WELL_KNOWN = {
    f"google.protobuf.{name}": module.DESCRIPTOR
    for module in (import_module(f"google.protobuf.{f}_pb2") for f in WELL_KNOWN_FILES.split())
    for name in (*module.DESCRIPTOR.message_types_by_name, *module.DESCRIPTOR.enum_types_by_name)
}
"""Google's own files by the full names of their types."""
OPAQUE_TYPES = {F.TYPE_MESSAGE: F.TYPE_BYTES, F.TYPE_ENUM: F.TYPE_INT32}
"""Type with the same wire format for a field whose type is not defined."""


@lru_cache(maxsize=256)
def build_type(schema_name: str, schema_data: bytes) -> Descriptor:
    """Build the message type of an MCAP schema.

    Parameters
    ----------
    schema_name
        Full name of the message.
    schema_data
        Serialized FileDescriptorSet.

    Raises
    ------
    google.protobuf.message.DecodeError
        If the bytes are not a descriptor set.
    KeyError, TypeError
        If the message is not defined, or its definition is not valid.
    """
    files: dict[str, FileDescriptorProto] = {}
    defined: set[str] = set()
    for file in FileDescriptorSet.FromString(schema_data).file:
        if file.name not in files:
            _remove_twins(file, defined)
            files[file.name] = file
            defined.update(_iter_type_names(file))
    for missing in sorted(_find_references(files.values()) - defined):
        for added in _iter_known_files(missing):
            files.setdefault(added.name, added)
            defined.update(_iter_type_names(added))
    for file in files.values():
        _make_opaque(file, defined)
    pool = _build_pool(list(files.values()))
    return pool.FindMessageTypeByName(schema_name.lstrip("."))


def _build_pool(pending: list[FileDescriptorProto]) -> DescriptorPool:
    """Build a pool of files in any order.

    Every file may use all files before it, whatever its imports say. Files that cannot be added
    are left out.

    Raises
    ------
    TypeError
        If no file can be added: the reason of the last.
    """
    pool = DescriptorPool()
    loaded: list[str] = []
    why: TypeError | None = None
    while pending:
        waiting = []
        for file in pending:
            del file.public_dependency[:], file.weak_dependency[:], file.option_dependency[:]
            file.dependency[:] = loaded
            try:
                pool.AddSerializedFile(file.SerializeToString())
                loaded.append(file.name)
            except TypeError as e:
                why = e
                waiting.append(file)
        if len(waiting) == len(pending):
            break
        pending = waiting[::-1]
    if why is not None and not loaded:
        raise why
    return pool


def _iter_messages(file: FileDescriptorProto) -> Iterator[tuple[str, DescriptorProto]]:
    """Yield all messages of a file with their full names."""
    held = [(file.package, message) for message in file.message_type]
    while held:
        within, message = held.pop()
        name = f"{within}.{message.name}" if within else message.name
        yield name, message
        held += [(name, nested) for nested in message.nested_type]


def _iter_type_names(file: FileDescriptorProto) -> Iterator[str]:
    prefix = f"{file.package}." if file.package else ""
    yield from (prefix + enum.name for enum in file.enum_type)
    for name, message in _iter_messages(file):
        yield name
        yield from (f"{name}.{enum.name}" for enum in message.enum_type)


def _remove_twins(file: FileDescriptorProto, defined: set[str]) -> None:
    """Remove the types of a file that other files define already, under other file names."""
    prefix = f"{file.package}." if file.package else ""
    for message in [one for one in file.message_type if prefix + one.name in defined]:
        file.message_type.remove(message)
    for enum in [one for one in file.enum_type if prefix + one.name in defined]:
        file.enum_type.remove(enum)


def _iter_fields(file: FileDescriptorProto) -> Iterator[FieldDescriptorProto]:
    yield from file.extension
    for _, message in _iter_messages(file):
        yield from message.field
        yield from message.extension


def _find_references(files: Iterable[FileDescriptorProto]) -> set[str]:
    """Return the full names of all types that fields use or extend."""
    fields = [field for file in files for field in _iter_fields(file)]
    return {name[1:] for f in fields for name in (f.type_name, f.extendee) if name.startswith(".")}


def _iter_known_files(name: str) -> Iterator[FileDescriptorProto]:
    """Yield the file of a type of Google or dmrl, and its imports."""
    held: list[FileDescriptor] = [WELL_KNOWN[name]] if name in WELL_KNOWN else []
    if name.startswith(tuple(f"{package}." for package in PACKAGES)):
        with suppress(KeyError):
            held.append(find_descriptor(name).file)
    while held:
        file = held.pop()
        held += file.dependencies
        yield FileDescriptorProto.FromString(file.serialized_pb)


def _make_opaque(file: FileDescriptorProto, defined: set[str]) -> None:
    """Change fields of undefined types to plain ones; remove extensions of undefined messages."""

    def is_undefined(name: str) -> bool:
        return name.startswith(".") and name[1:] not in defined

    del file.service[:]
    holders: list[FileDescriptorProto | DescriptorProto] = [file]
    holders += [message for _, message in _iter_messages(file)]
    for holder in holders:
        for field in [e for e in holder.extension if is_undefined(e.extendee)]:
            holder.extension.remove(field)
    for field in _iter_fields(file):
        field.json_name = field.name  # names that differ in underscores alone would collide
        if is_undefined(field.type_name) and field.type in OPAQUE_TYPES:
            field.type = OPAQUE_TYPES[field.type]
            field.ClearField("type_name")
            field.ClearField("default_value")
