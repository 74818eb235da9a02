"""Random protobuf definitions and messages of every allowed shape, for tests of the decoder.

Nothing here comes from dmrl: Google's protobuf package builds and serializes all of them.
"""

import random
from collections.abc import Iterator
from typing import Any

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import (
    EDITION_2023,
    DescriptorProto,
    FeatureSet,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.struct_pb2 import DESCRIPTOR as STRUCT
from google.protobuf.timestamp_pb2 import DESCRIPTOR as TIMESTAMP
from google.protobuf.wrappers_pb2 import DESCRIPTOR as WRAPPERS

F = FieldDescriptorProto
SCALARS = (
    *(F.TYPE_DOUBLE, F.TYPE_FLOAT, F.TYPE_INT64, F.TYPE_UINT64, F.TYPE_INT32, F.TYPE_FIXED64),
    *(F.TYPE_FIXED32, F.TYPE_BOOL, F.TYPE_STRING, F.TYPE_BYTES, F.TYPE_UINT32, F.TYPE_SFIXED32),
    *(F.TYPE_SFIXED64, F.TYPE_SINT32, F.TYPE_SINT64),
)
KEYS = tuple(set(SCALARS) - {F.TYPE_DOUBLE, F.TYPE_FLOAT, F.TYPE_BYTES})
PACKABLE = (*(set(SCALARS) - {F.TYPE_STRING, F.TYPE_BYTES}), F.TYPE_ENUM)
WELL_KNOWN = (
    "google.protobuf.Timestamp",
    "google.protobuf.Struct",
    "google.protobuf.DoubleValue",
)
LIMITS = {
    F.TYPE_INT32: (-(2**31), 2**31 - 1),
    F.TYPE_SINT32: (-(2**31), 2**31 - 1),
    F.TYPE_SFIXED32: (-(2**31), 2**31 - 1),
    F.TYPE_UINT32: (0, 2**32 - 1),
    F.TYPE_FIXED32: (0, 2**32 - 1),
    F.TYPE_INT64: (-(2**63), 2**63 - 1),
    F.TYPE_SINT64: (-(2**63), 2**63 - 1),
    F.TYPE_SFIXED64: (-(2**63), 2**63 - 1),
    F.TYPE_UINT64: (0, 2**64 - 1),
    F.TYPE_FIXED64: (0, 2**64 - 1),
}


class Definitions:
    """Random files that import each other; ``messages`` are named ``.p0.M0`` and so on."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.files: list[FileDescriptorProto] = []
        self.messages: list[str] = []
        for number in range(self.rng.randint(1, 3)):
            self._add_file(number)

    def _add_file(self, number: int) -> None:
        syntax = self.rng.choice(["proto2", "proto3", "editions"])
        package = self.rng.choice([f"p{number}", f"p{number}.sub", f"q{number}"])
        file = FileDescriptorProto(name=f"dir/{number}.proto", package=package, syntax=syntax)
        if syntax == "editions":
            file.edition = EDITION_2023
            options = file.options.features
            options.enum_type = self.rng.choice([FeatureSet.OPEN, FeatureSet.CLOSED])
            options.repeated_field_encoding = self.rng.choice(
                [FeatureSet.PACKED, FeatureSet.EXPANDED]
            )
            options.field_presence = self.rng.choice([FeatureSet.EXPLICIT, FeatureSet.IMPLICIT])
        file.dependency.extend(f.name for f in self.files)
        file.dependency.extend(
            f"google/protobuf/{name}.proto" for name in ("timestamp", "struct", "wrappers")
        )
        enum = file.enum_type.add(name=f"E{number}")
        for name, value in (("A", 0), ("B", 1), ("C", -5), ("D", 70000)):
            enum.value.add(name=f"E{number}_{name}", number=value)
        own = [f".{package}.M{k}" for k in range(self.rng.randint(1, 3))]
        for k, name in enumerate(own):
            message = file.message_type.add(name=f"M{k}")
            self._fill(message, name, file, own[:k] + ([name] if self.rng.random() < 0.2 else []))
        self.files.append(file)
        self.messages += own
        if syntax != "proto3":
            self._add_extensions(file)

    def _add_extensions(self, file: FileDescriptorProto) -> None:
        for message in file.message_type:
            if self.rng.random() < 0.5:
                message.extension_range.add(start=1000, end=2000)
                target = f".{file.package}.{message.name}"
                for k in range(2):
                    extension = file.extension.add(
                        name=f"ext_{message.name}_{k}".lower(), number=1000 + k, extendee=target
                    )
                    extension.type = self.rng.choice(SCALARS)
                    extension.label = self.rng.choice([F.LABEL_OPTIONAL, F.LABEL_REPEATED])

    def _fill(
        self, message: DescriptorProto, name: str, file: FileDescriptorProto, near: list[str]
    ) -> None:
        oneofs = self.rng.randint(0, 2)
        for k in range(oneofs):
            message.oneof_decl.add(name=f"choice{k}")
            for _ in range(2):
                field = self._add_field(message, name, file, near, F.LABEL_OPTIONAL)
                field.oneof_index = k
                field.options.Clear()
                field.ClearField("default_value")
        for _ in range(self.rng.randint(0, 6)):
            label = self.rng.choice([F.LABEL_OPTIONAL, F.LABEL_OPTIONAL, F.LABEL_REPEATED])
            self._add_field(message, name, file, near, label)
        if self.rng.random() < 0.4:
            self._add_map(message, name, near)
        if file.syntax == "proto3" and self.rng.random() < 0.5:
            field = message.field.add(
                name="maybe", number=777, type=self.rng.choice(SCALARS), label=F.LABEL_OPTIONAL
            )
            message.oneof_decl.add(name="_maybe")
            field.oneof_index, field.proto3_optional = len(message.oneof_decl) - 1, True

    def _add_field(
        self,
        message: DescriptorProto,
        name: str,
        file: FileDescriptorProto,
        near: list[str],
        label: Any,
    ) -> FieldDescriptorProto:
        number = self.rng.choice([1, 15, 16, 2047, 2048, 100000, 536870911])
        taken = {777, 900, *(f.number for f in message.field)}
        while number in taken or 999 <= number <= 2000 or 19000 <= number < 20000:
            number = self.rng.randint(1, 5000)
        field = message.field.add(name=f"f{number}", number=number, label=label)
        known = near + self.messages + [f".{well}" for well in WELL_KNOWN]
        sort = self.rng.random()
        if sort < 0.25:
            field.type, field.type_name = F.TYPE_MESSAGE, self.rng.choice(known)
            if file.syntax == "editions" and self.rng.random() < 0.5:
                field.options.features.message_encoding = FeatureSet.DELIMITED
        elif sort < 0.35:
            field.type, field.type_name = F.TYPE_ENUM, f".{file.package}.{file.enum_type[0].name}"
        elif sort < 0.42 and file.syntax == "proto2":
            group = message.nested_type.add(name=f"G{number}")
            group.field.add(name="a", number=1, type=F.TYPE_INT32, label=F.LABEL_OPTIONAL)
            group.field.add(name="b", number=2, type=F.TYPE_STRING, label=F.LABEL_REPEATED)
            field.type, field.type_name = F.TYPE_GROUP, f"{name}.G{number}"
            field.name = f"g{number}"
        else:
            field.type = self.rng.choice(SCALARS)
        if label == F.LABEL_REPEATED and field.type in PACKABLE and file.syntax != "editions":
            field.options.packed = self.rng.random() < 0.5
        if file.syntax == "proto2" and label == F.LABEL_OPTIONAL:
            self._add_default(field)
        return field

    def _add_default(self, field: FieldDescriptorProto) -> None:
        if self.rng.random() < 0.5:
            return
        if field.type in LIMITS:
            field.default_value = str(self.rng.randint(*LIMITS[field.type]))
        elif field.type in (F.TYPE_DOUBLE, F.TYPE_FLOAT):
            field.default_value = self.rng.choice(["1.5", "-inf", "-0.25"])
        elif field.type == F.TYPE_STRING:
            field.default_value = "Bär"
        elif field.type == F.TYPE_BYTES:
            field.default_value = "\\000\\377x"
        elif field.type == F.TYPE_BOOL:
            field.default_value = "true"

    def _add_map(self, message: DescriptorProto, name: str, near: list[str]) -> None:
        entry = message.nested_type.add(name="TableEntry")
        entry.options.map_entry = True
        key = self.rng.choice(KEYS)
        entry.field.add(name="key", number=1, type=key, label=F.LABEL_OPTIONAL)
        value = entry.field.add(name="value", number=2, label=F.LABEL_OPTIONAL)
        if self.rng.random() < 0.4:
            value.type = F.TYPE_MESSAGE
            value.type_name = self.rng.choice(near + self.messages + [f".{WELL_KNOWN[0]}"])
        else:
            value.type = self.rng.choice(SCALARS)
        message.field.add(
            name="table",
            number=900,
            type=F.TYPE_MESSAGE,
            type_name=f"{name}.TableEntry",
            label=F.LABEL_REPEATED,
        )

    def build_pool(self) -> DescriptorPool:
        """Return Google's descriptor pool of all files, added in their order."""
        pool = DescriptorPool()
        for known in (TIMESTAMP, STRUCT, WRAPPERS):
            pool.AddSerializedFile(known.serialized_pb)
        for file in self.files:
            pool.AddSerializedFile(file.SerializeToString())
        return pool

    def build_schema(self) -> bytes:
        """Return a descriptor set of all files, in random order as some writers have it.

        Each of Google's own files that they import is missing at random.
        """
        held = list(self.files)
        for known in (TIMESTAMP, STRUCT, WRAPPERS):
            if self.rng.random() < 0.5:
                held.append(FileDescriptorProto.FromString(known.serialized_pb))
        self.rng.shuffle(held)
        return FileDescriptorSet(file=held).SerializeToString()

    def build_payloads(self, kind: Descriptor, count: int) -> list[bytes]:
        """Return serialized messages; some are several concatenated ones, which protobuf merges."""
        build = GetMessageClass(kind)
        return [
            b"".join(
                self._message(build(), 0).SerializePartialToString()
                for _ in range(self.rng.choice([1, 1, 1, 2, 3]))
            )
            for _ in range(count)
        ]

    def _message(self, message: Any, depth: int) -> Any:
        pool = message.DESCRIPTOR.file.pool
        for field in message.DESCRIPTOR.fields:
            if self.rng.random() < 0.6:
                self._set(message, field, depth)
        for extension in pool.FindAllExtensions(message.DESCRIPTOR):
            if extension.is_repeated:
                message.Extensions[extension].extend(self._scalar(extension) for _ in range(2))
            else:
                message.Extensions[extension] = self._scalar(extension)
        return message

    def _set(self, message: Any, field: FieldDescriptor, depth: int) -> None:
        inner = field.message_type
        if inner is not None and inner.GetOptions().map_entry:
            self._set_map(getattr(message, field.name), inner, depth)
        elif inner is not None:
            if depth > 3:
                return
            for _ in range(self.rng.randint(0, 2) if field.is_repeated else 1):
                held = getattr(message, field.name)
                if field.is_repeated:
                    held = held.add()
                held.SetInParent() if not field.is_repeated else None
                self._message(held, depth + 1)
        elif field.is_repeated:
            getattr(message, field.name).extend(
                self._scalar(field) for _ in range(self.rng.randint(0, 3))
            )
        else:
            setattr(message, field.name, self._scalar(field))

    def _set_map(self, held: Any, entry: Descriptor, depth: int) -> None:
        key, value = entry.fields_by_name["key"], entry.fields_by_name["value"]
        for _ in range(self.rng.randint(0, 3)):
            if value.message_type is None:
                held[self._scalar(key)] = self._scalar(value)
            elif depth <= 3:
                self._message(held[self._scalar(key)], depth + 1)

    def _scalar(self, field: FieldDescriptor) -> Any:
        kind = field.type
        if field.full_name.startswith("google.") and kind in (*LIMITS, F.TYPE_DOUBLE, F.TYPE_ENUM):
            # JSON limits the values of Google's own types, such as times.
            return self.rng.randint(0, 0 if kind == F.TYPE_ENUM else 1000)
        if field.enum_type is not None:
            return self.rng.choice([0, 1, -5, 70000])
        if kind in LIMITS:
            return self.rng.choice([0, 1, *LIMITS[kind], self.rng.randint(*LIMITS[kind])])
        if kind in (F.TYPE_DOUBLE, F.TYPE_FLOAT):
            return self.rng.choice([0.0, -0.0, 1.5, float("inf"), 2.0**-20])
        if kind == F.TYPE_BOOL:
            return self.rng.random() < 0.5
        text = "".join(self.rng.choice("aß漢 \n") for _ in range(self.rng.randint(0, 60)))
        return text if kind == F.TYPE_STRING else text.encode("utf-16")


def iter_definitions(seeds: range) -> Iterator[tuple[Definitions, DescriptorPool]]:
    """Yield the definitions of each seed with Google's descriptor pool of them."""
    for seed in seeds:
        made = Definitions(seed)
        yield made, made.build_pool()
