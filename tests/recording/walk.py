"""Read an MCAP file record by record, without its index, the mcap package or dmrl.

It follows the specification (https://mcap.dev/spec) and is the oracle of the tests of copies.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import lz4.frame
import zstandard

SCHEMA, CHANNEL, MESSAGE, CHUNK, ATTACHMENT, METADATA = 3, 4, 5, 6, 9, 12
MAGIC = b"\x89MCAP0\r\n"


@dataclass
class Content:
    """Content of a file outside its summary; schemas and channels by their IDs."""

    schemas: dict[int, tuple] = field(default_factory=dict)
    channels: dict[int, tuple] = field(default_factory=dict)
    raw_messages: list[tuple] = field(default_factory=list)
    attachments: list[tuple] = field(default_factory=list)
    metadata: list[tuple] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)  # bad chunks, contradictory definitions

    def channel(self, number: int) -> tuple:
        """Return topic, encoding, metadata and schema of a channel."""
        topic, encoding, pairs, schema = self.channels[number]
        return topic, encoding, pairs, self.schemas[schema] if schema else None

    @property
    def messages(self) -> list[tuple]:
        """Return channel, log time, publish time, sequence and data of each, sorted."""
        return sorted(((self.channel(n), *rest) for n, *rest in self.raw_messages), key=repr)

    def set_aside_nameless(self) -> None:
        """Remove channels without their schema, and messages without their channel."""
        known = {
            n: channel
            for n, channel in self.channels.items()
            if not channel[3] or channel[3] in self.schemas
        }
        kept = [message for message in self.raw_messages if message[0] in known]
        if lost := len(self.raw_messages) - len(kept):
            self.unreadable.append(f"{lost} messages without a channel")
        self.channels, self.raw_messages = known, kept

    def comparable(self) -> dict[str, list]:
        """Return all content as sorted lists, except what dmrl adds to its own copies."""
        return {
            "messages": self.messages,
            "channels": sorted((self.channel(n) for n in self.channels), key=repr),
            "schemas": sorted(set(self.schemas.values())),
            "attachments": sorted(a for a in self.attachments if a[0] != "recipe.toml"),
            "metadata": sorted(m for m in self.metadata if not m[0].startswith("dmrl.")),
        }


def parse_text(data: bytes, at: int) -> tuple[str, int]:
    """Return the string at an offset, and the offset behind it."""
    size = int.from_bytes(data[at : at + 4], "little")
    return data[at + 4 : at + 4 + size].decode(), at + 4 + size


def parse_pairs(data: bytes, at: int) -> tuple[tuple[tuple[str, str], ...], int]:
    """Return the map at an offset as sorted pairs, and the offset behind it."""
    end = at + 4 + int.from_bytes(data[at : at + 4], "little")
    at, found = at + 4, {}
    while at < end:
        key, at = parse_text(data, at)
        found[key], at = parse_text(data, at)
    return tuple(sorted(found.items())), at


def decompress_chunk(kind: str, data: bytes, size: int) -> bytes:
    """Return the records of a chunk of this compression and uncompressed size, bytes."""
    if not data:  # an empty chunk is readable whatever compression it states
        return b""
    if kind == "zstd":
        return zstandard.ZstdDecompressor().decompress(data, size) if size else b""
    return lz4.frame.decompress(data) if kind == "lz4" else {"": data}[kind]


def iter_records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of each record."""
    at = 0
    while at < len(data):
        opcode, size = struct.unpack_from("<BQ", data, at)
        yield opcode, data[at + 9 : at + 9 + size]
        at += 9 + size


def walk(path: Path) -> Content:
    """Return the content of a complete file."""
    found = Content()
    for opcode, body in iter_records(path.read_bytes()[len(MAGIC) : -len(MAGIC)]):
        add_record(found, opcode, body)
    return found


def add_record(found: Content, opcode: int, body: bytes) -> None:
    """Add the content of a record, and of all records of a chunk."""
    if opcode == SCHEMA:
        name, at = parse_text(body, 2)
        encoding, at = parse_text(body, at)
        size = int.from_bytes(body[at : at + 4], "little")
        made = name, encoding, body[at + 4 : at + 4 + size]
        if found.schemas.setdefault(int.from_bytes(body[:2], "little"), made) != made:
            found.unreadable.append("a schema is defined otherwise")
    elif opcode == CHANNEL:
        number, schema = struct.unpack_from("<HH", body)
        topic, at = parse_text(body, 4)
        encoding, at = parse_text(body, at)
        made = topic, encoding, parse_pairs(body, at)[0], schema
        if found.channels.setdefault(number, made) != made:
            found.unreadable.append("a channel is defined otherwise")
    elif opcode == MESSAGE:
        number, sequence, log_ns, publish_ns = struct.unpack_from("<HIQQ", body)
        found.raw_messages.append((number, log_ns, publish_ns, sequence, body[22:]))
    elif opcode == CHUNK:
        size, at = int.from_bytes(body[16:24], "little"), 28
        kind, at = parse_text(body, at)
        length = int.from_bytes(body[at : at + 8], "little")
        try:
            inner = decompress_chunk(kind, body[at + 8 : at + 8 + length], size)
            assert len(inner) == size
        except (RuntimeError, zstandard.ZstdError, KeyError, AssertionError) as e:
            found.unreadable.append(str(e))
            return
        for each, part in iter_records(inner):
            add_record(found, each, part)
    elif opcode == ATTACHMENT:
        log_ns, create_ns = struct.unpack_from("<QQ", body)
        name, at = parse_text(body, 16)
        media, at = parse_text(body, at)
        size = int.from_bytes(body[at : at + 8], "little")
        found.attachments.append((name, media, log_ns, create_ns, body[at + 8 : at + 8 + size]))
    elif opcode == METADATA:
        name, at = parse_text(body, 0)
        found.metadata.append((name, parse_pairs(body, at)[0]))
