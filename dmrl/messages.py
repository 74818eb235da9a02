"""Message classes, built at run time from the committed descriptor set.

There is no generated ``_pb2.py``: it would pin the protobuf runtime. ``schemas/`` holds the
definitions with their units and frames; ``make schemas`` rebuilds the set.
"""

from functools import cache
from importlib.resources import files
from typing import Any

from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

PACKAGES = ("dmrl.v1", "foxglove")


@cache
def _pool() -> DescriptorPool:
    data = files("dmrl.schemas").joinpath("dmrl.binpb").read_bytes()
    return pool_of(data)


def pool_of(descriptor_set: bytes) -> DescriptorPool:
    """A pool with every file of a serialized FileDescriptorSet.

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
def descriptor(name: str) -> Descriptor:
    """Descriptor of a message of dmrl or foxglove.

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
            return _pool().FindMessageTypeByName(full)
        except KeyError:
            continue
    raise KeyError(name)


@cache
def message(name: str) -> Any:
    """Class of a message: ``message("Height")(height_m=0.4)``.

    Parameters
    ----------
    name
        Short or full name; dmrl.v1 is looked in first, then foxglove.

    Raises
    ------
    KeyError
        If there is no such message.
    """
    return GetMessageClass(descriptor(name))


@cache
def schema_bytes(name: str) -> bytes:
    """Serialized FileDescriptorSet of a message and all it imports, as MCAP wants it."""
    found: dict[str, FileDescriptor] = {}

    def visit(file: FileDescriptor) -> None:
        for dependency in file.dependencies:
            visit(dependency)
        found.setdefault(file.name, file)

    visit(descriptor(name).file)
    out = FileDescriptorSet()
    for file in found.values():
        file.CopyToProto(out.file.add())
    return out.SerializeToString(deterministic=True)


STATUS_OK, STATUS_UNCONVERGED, STATUS_AMBIGUOUS = range(3)
"""Values of ``dmrl.v1.Status``; a test holds them to the schema."""
