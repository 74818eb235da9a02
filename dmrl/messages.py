"""Message classes, built at run time from the committed descriptor set.

There is no generated ``_pb2.py``: it would pin the protobuf runtime. ``schemas/`` contains the
definitions with their units and frames; ``make schemas`` rebuilds the set.
"""

import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import (
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from dmrl.errors import SourceError
from dmrl.guards import limits

PACKAGES = ("dmrl.v1", "foxglove")


@cache
def _load_pool() -> DescriptorPool:
    data = files("dmrl.schemas").joinpath("dmrl.binpb").read_bytes()
    return build_pool(data)


def build_pool(descriptor_set: bytes) -> DescriptorPool:
    """Build a pool with every file of a serialized FileDescriptorSet.

    Raises
    ------
    google.protobuf.message.DecodeError, TypeError
        If the bytes are not a descriptor set, or a file's imports are missing.
    """
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set).file:
        pool.AddSerializedFile(file.SerializeToString())
    return pool


@cache
def find_descriptor(name: str) -> Descriptor:
    """Return the descriptor of a message of dmrl or foxglove.

    Parameters
    ----------
    name
        Short ("PeerLabels") or full ("dmrl.v1.PeerLabels").

    Raises
    ------
    KeyError
        If there is no such message.
    """
    for full in (name, *(f"{package}.{name}" for package in PACKAGES)):
        try:
            return _load_pool().FindMessageTypeByName(full)
        except KeyError:
            continue
    raise KeyError(name)


def to_status_name(number: int) -> str:
    """Return the name of a label's or position's status; the number if the status is unknown."""
    kind = find_descriptor("PeerLabel").fields_by_name["status"].enum_type
    known = kind.values_by_number if kind is not None else {}
    return str(known[number].name) if number in known else str(number)


@dataclass(frozen=True, slots=True)
class LogType:
    """Message type of one block of log variables.

    Its full name is ``dmrl.log.<name>``. Its fields are the variables, with ``_`` for every
    character that protobuf does not allow; the JSON names are those of the variables.

    Parameters
    ----------
    name
        Name of the event or block.
    variables
        Names and types, as letters of ``struct``: ``b B h H i I q e f d``.

    Raises
    ------
    SourceError
        If there are more variables than a log may have.
    """

    name: str
    variables: tuple[tuple[str, str], ...]

    def __post_init__(self) -> None:
        if len(self.variables) > limits.VARIABLES:
            raise SourceError(
                f"the log of {self.name[:40]} has {len(self.variables)} variables, more than "
                f"{limits.VARIABLES}. Remove some"
            )

    @property
    def fields(self) -> tuple[str, ...]:
        """Field of each variable, all different."""
        found: list[str] = []
        names = [variable for variable, _ in self.variables]
        for variable in names:
            name = _to_identifier(variable)
            while name in found or (name in names and name != variable):
                name += "_"
            found.append(name)
        return tuple(found)


LOG_PACKAGE = "dmrl.log"
_F = FieldDescriptorProto
_TYPE_BY_CODE = dict.fromkeys("BHI", _F.TYPE_UINT32) | dict.fromkeys("bhi", _F.TYPE_SINT32)
_TYPE_BY_CODE |= {"q": _F.TYPE_SINT64, "e": _F.TYPE_FLOAT, "f": _F.TYPE_FLOAT, "d": _F.TYPE_DOUBLE}


def _to_identifier(text: str) -> str:
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return name if name[:1].isalpha() else f"v_{name}"


def _build_log_descriptor(kind: LogType) -> Descriptor:
    name = _to_identifier(kind.name)
    file = FileDescriptorProto(
        name=f"{LOG_PACKAGE}/{name}.proto", package=LOG_PACKAGE, syntax="proto3"
    )
    body = file.message_type.add(name=name)
    for number, ((variable, code), field) in enumerate(
        zip(kind.variables, kind.fields, strict=True), 1
    ):
        body.field.add(
            name=field,
            json_name=variable,
            number=number,
            type=_TYPE_BY_CODE[code],
            label=_F.LABEL_OPTIONAL,
        )
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return pool.FindMessageTypeByName(f"{LOG_PACKAGE}.{name}")


@cache
def message_class(name: str | LogType) -> Any:
    """Return the class of a message: ``message_class("Height")(height_m=0.4)``.

    Parameters
    ----------
    name
        Short or full name, first searched in dmrl.v1, then in foxglove; or the variables of a log.

    Raises
    ------
    KeyError
        If there is no such message.
    """
    return GetMessageClass(
        _build_log_descriptor(name) if isinstance(name, LogType) else find_descriptor(name)
    )


@cache
def serialize_schema(name: str | Descriptor) -> bytes:
    """Serialize the FileDescriptorSet of a message and all its imports, as MCAP requires."""
    found: dict[str, FileDescriptor] = {}

    def visit(file: FileDescriptor) -> None:
        for dependency in file.dependencies:
            visit(dependency)
        found.setdefault(file.name, file)

    visit((find_descriptor(name) if isinstance(name, str) else name).file)
    out = FileDescriptorSet()
    for file in found.values():
        file.CopyToProto(out.file.add())
    return out.SerializeToString(deterministic=True)


STATUS_OK, STATUS_UNCONVERGED, STATUS_AMBIGUOUS = range(3)
"""Values of ``dmrl.v1.Status``; a test compares them with the schema."""
