"""Random MCAP files: layouts that the specification allows, written byte by byte.

This module imports nothing from dmrl, so that tests compare two independent implementations.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
(HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, CHUNK_INDEX) = range(1, 9)
(ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, OFFSET, DATA_END) = range(
    9, 16
)
UNKNOWN = (0x10, 0x42, 0x80, 0xFF)


def clip_to_uint64(*values: int) -> tuple[int, ...]:
    """Return the values, clipped to the range of an unsigned 64-bit integer."""
    return tuple(min(max(value, 0), 2**64 - 1) for value in values)


def pack_text(value: str) -> bytes:
    """Return a string as MCAP stores it: its length in bytes, then UTF-8."""
    return struct.pack("<I", len(value.encode())) + value.encode()


def pack_pairs(values: dict[str, str]) -> bytes:
    """Return a map of strings as MCAP stores it: its length in bytes, then keys and values."""
    body = b"".join(pack_text(key) + pack_text(value) for key, value in values.items())
    return struct.pack("<I", len(body)) + body


@dataclass
class Message:
    """A message; its times are in nanoseconds."""

    channel: int
    time: int
    publish: int
    data: bytes
    sequence: int = 0

    def body(self) -> bytes:
        head = struct.pack("<HIQQ", self.channel, self.sequence, self.time, self.publish)
        return head + self.data


@dataclass
class Chunk:
    """A chunk, and the changes to make to it and to its indexes."""

    messages: list[Message]
    compression: str = ""
    named: str | None = None  # stated compression, if not the one used
    size_more: int = 0  # added to the stated uncompressed size
    definitions: list[int] = field(default_factory=list)  # channels defined before the messages
    times: tuple[int, int] | None = None  # stated first and last time, in chunk and index
    index_times: tuple[int, int] | None = None  # the same, in the index only
    entries: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    change_entries: list[Callable[[dict[int, list[tuple[int, int]]]], None]] = field(
        default_factory=list
    )
    change_offsets: list[Callable[[dict[int, int]], None]] = field(default_factory=list)
    listed: int = 1  # number of chunk indexes
    shift: int = 0  # added to the offset in the chunk index
    length_more: int = 0  # added to the stated length of the message indexes
    unknown: int = 0  # opcode of unknown records between the messages; 0: none
    at: int = 0  # offset in the file, set when written


@dataclass
class Layout:
    """A file to write: its records, which optional ones it has, and the changes to make."""

    channels: dict[int, tuple[str, int, dict[str, str]]] = field(default_factory=dict)
    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    parts: list[object] = field(default_factory=list)  # chunks, messages, records
    crcs: bool = True
    indexed: bool = True  # has message indexes
    statistics: bool = True
    counts: bool = True  # the statistics have message counts by channel
    repeat: bool = True  # the summary repeats schemas and channels
    chunk_indexes: bool = True
    extra_indexes: bool = True
    offsets: bool = True
    padding: int = 0  # trailing bytes of each record
    change_statistics: list[Callable[[dict[str, int], Counter[int]], None]] = field(
        default_factory=list
    )
    change_summary_start: Callable[[int, list[int]], int] | None = None
    summary_topic: bool = False  # the summary has another topic for every channel
    after_end: list[Message] = field(default_factory=list)  # written after the Data End record
    unknown_in_summary: int = 0  # opcode of an unknown record there; 0: none
    shift_extra: int = 0  # added to the offsets of metadata and attachments
    repeat_extra: int = 1  # number of indexes of each of them
    extra_count_more: int = 0

    @property
    def chunks(self) -> list[Chunk]:
        return [part for part in self.parts if isinstance(part, Chunk)]

    @property
    def messages(self) -> list[Message]:
        loose = [part for part in self.parts if isinstance(part, Message)]
        return [m for chunk in self.chunks for m in chunk.messages] + loose


class Writer:
    """Writes a layout to bytes."""

    def __init__(self, layout: Layout) -> None:
        self.layout, self.out = layout, bytearray(MAGIC)
        self.starts: list[int] = []
        self.extras: list[bytes] = []

    def build_record(self, opcode: int, body: bytes, *, padded: bool = True) -> bytes:
        """Return a record: opcode, length and body, padded as the layout asks."""
        known = opcode not in (MESSAGE, FOOTER) and padded
        body += bytes(self.layout.padding) if known else b""
        return struct.pack("<BQ", opcode, len(body)) + body

    def append(self, record: bytes) -> int:
        """Append a record to the file and return its offset."""
        at = len(self.out)
        self.starts.append(at)
        self.out += record
        return at

    def build_definition(self, number: int, topic: str | None = None) -> bytes:
        """Return the definition of a channel, with its schema before it if it has one."""
        own, schema, metadata = self.layout.channels[number]
        found = b""
        if schema in self.layout.schemas:
            found += self.build_schema(schema)
        body = struct.pack("<HH", number, schema) + pack_text(topic or own) + pack_text("json")
        return found + self.build_record(CHANNEL, body + pack_pairs(metadata))

    def build_schema(self, number: int) -> bytes:
        name, encoding, data = self.layout.schemas[number]
        body = struct.pack("<H", number) + pack_text(name) + pack_text(encoding)
        return self.build_record(SCHEMA, body + struct.pack("<I", len(data)) + data)

    def write_chunk(self, chunk: Chunk) -> list[bytes]:
        """Write a chunk with its message indexes; return its chunk indexes."""
        inner = bytearray().join(self.build_definition(n) for n in chunk.definitions)
        entries: dict[int, list[tuple[int, int]]] = {}
        for message in chunk.messages:
            if chunk.unknown:
                inner += self.build_record(chunk.unknown, b"xyz", padded=False)
            entries.setdefault(message.channel, []).append((message.time, len(inner)))
            inner += self.build_record(MESSAGE, message.body())
        size, kind = len(inner) + chunk.size_more, chunk.compression
        data = bytes(inner)
        if kind == "zstd":
            data = zstandard.ZstdCompressor().compress(data)
        elif kind == "lz4":
            data = lz4.frame.compress(data)
        found = [m.time for m in chunk.messages] or [0]
        times = chunk.times or (min(found), max(found))
        crc = zlib.crc32(inner) if self.layout.crcs else 0
        name = chunk.named or kind
        body = struct.pack("<QQQI", *clip_to_uint64(*times, size), crc) + pack_text(name)
        chunk.at = self.append(self.build_record(CHUNK, body + struct.pack("<Q", len(data)) + data))
        length, offsets = len(self.out) - chunk.at, dict[int, int]()
        for change in chunk.change_entries:
            change(entries)
        if self.layout.indexed:
            for number, own in entries.items():
                flat = b"".join(struct.pack("<QQ", *clip_to_uint64(*entry)) for entry in own)
                body = struct.pack("<HI", number, len(flat)) + flat
                offsets[number] = self.append(self.build_record(INDEX, body))
        indexes = len(self.out) - chunk.at - length + chunk.length_more
        for move in chunk.change_offsets:
            move(offsets)
        flat = b"".join(struct.pack("<HQ", *one) for one in offsets.items())
        body = struct.pack("<QQ", *clip_to_uint64(*(chunk.index_times or times)))
        body += struct.pack("<QQI", chunk.at + chunk.shift, length, len(flat)) + flat
        body += (
            struct.pack("<Q", max(indexes, 0))
            + pack_text(kind)
            + struct.pack("<QQ", *clip_to_uint64(len(data), size))
        )
        return [self.build_record(CHUNK_INDEX, body)] * chunk.listed

    def write_extra(self, opcode: int, body: bytes, index: bytes) -> None:
        """Append metadata or an attachment, and keep its index for the summary."""
        record = self.build_record(opcode, body)
        at = self.append(record)
        places = struct.pack("<QQ", at + self.layout.shift_extra, len(record))
        kind = METADATA_INDEX if opcode == METADATA else ATTACHMENT_INDEX
        self.extras += [self.build_record(kind, places + index)] * self.layout.repeat_extra

    def write_part(self, part: object) -> list[bytes]:
        """Append a part of the layout by its type; return the chunk indexes of a chunk.

        A positive integer is a channel to define, a negative one an unknown opcode.
        """
        if isinstance(part, Chunk):
            return self.write_chunk(part)
        if isinstance(part, Message):
            self.append(self.build_record(MESSAGE, part.body()))
        elif isinstance(part, int):
            if part >= 0:
                self.append(self.build_definition(part))
            else:
                self.append(self.build_record(-part, b"what nobody knows", padded=False))
        elif isinstance(part, dict):
            self.write_extra(METADATA, pack_text("own") + pack_pairs(part), pack_text("own"))
        elif isinstance(part, tuple):
            name, media, log, create, data = part
            body = struct.pack("<QQ", log, create) + pack_text(name) + pack_text(media)
            body += struct.pack("<Q", len(data)) + data
            crc = zlib.crc32(body) if self.layout.crcs else 0
            index = struct.pack("<QQQ", log, create, len(data)) + pack_text(name) + pack_text(media)
            self.write_extra(ATTACHMENT, body + struct.pack("<I", crc), index)
        return []

    def build_statistics(self) -> bytes:
        layout = self.layout
        messages = [*layout.messages, *layout.after_end]
        counts = Counter(m.channel for m in messages)
        times = [m.time for m in messages] or [0]
        told = {
            "messages": len(messages),
            "schemas": len(layout.schemas),
            "channels": len(layout.channels),
            "attachments": sum(isinstance(p, tuple) for p in layout.parts)
            + layout.extra_count_more,
            "metadata": sum(isinstance(p, dict) for p in layout.parts),
            "chunks": len(layout.chunks),
            "start": min(times),
            "end": max(times),
        }
        for change in layout.change_statistics:
            change(told, counts)
        values = {k: clip_to_uint64(v)[0] for k, v in told.items()}
        body = struct.pack(
            "<QHIIIIQQ",
            *(values[k] for k in ("messages", "schemas", "channels", "attachments")),
            *(values[k] for k in ("metadata", "chunks", "start", "end")),
        )
        kept = counts if layout.counts else {}
        flat = b"".join(struct.pack("<HQ", n, max(0, c)) for n, c in kept.items())
        return self.build_record(STATISTICS, body + struct.pack("<I", len(flat)) + flat)

    def write(self) -> bytes:
        layout = self.layout
        self.append(self.build_record(HEADER, pack_text("own") + pack_text("wrong meaning")))
        indexes = [index for part in layout.parts for index in self.write_part(part)]
        crc = zlib.crc32(self.out) if layout.crcs else 0
        self.append(self.build_record(DATA_END, struct.pack("<I", crc)))
        for message in layout.after_end:
            self.append(self.build_record(MESSAGE, message.body()))
        start, groups = len(self.out), list[list[bytes]]()
        if layout.repeat:
            groups.append([self.build_schema(n) for n in layout.schemas])
            topic = "/renamed" if layout.summary_topic else None
            bare = Layout(layout.channels)
            bare.padding = layout.padding
            groups.append([Writer(bare).build_definition(n, topic) for n in layout.channels])
        groups.append([self.build_statistics()] if layout.statistics else [])
        groups.append(indexes if layout.chunk_indexes else [])
        groups.append(self.extras if layout.extra_indexes else [])
        if layout.unknown_in_summary:
            groups.append([self.build_record(layout.unknown_in_summary, b"xyz", padded=False)])
        offsets = b""
        for group in groups:
            at = len(self.out)
            for record in group:
                self.append(record)
            if group and layout.offsets:
                body = struct.pack("<BQQ", group[0][0], at, len(self.out) - at)
                offsets += self.build_record(OFFSET, body)
        if not any(groups):
            start = 0
        elif layout.change_summary_start is not None:
            start = layout.change_summary_start(start, self.starts)
        offset_start = len(self.out) if offsets else 0
        self.out += offsets
        footer = struct.pack("<BQQQ", FOOTER, 20, start, offset_start)
        crc = zlib.crc32(self.out[start:] + footer) if layout.crcs and start else 0
        return bytes(self.out) + footer + struct.pack("<I", crc) + MAGIC


def draw_layout(rng: Random) -> Layout:
    """Draw a layout that the specification allows."""
    layout = Layout(
        crcs=rng.random() < 0.7,
        indexed=rng.random() < 0.8,
        statistics=rng.random() < 0.8,
        counts=rng.random() < 0.9,
        repeat=rng.random() < 0.9,
        chunk_indexes=rng.random() < 0.9,
        extra_indexes=rng.random() < 0.8,
        offsets=rng.random() < 0.7,
        padding=rng.choice([0, 0, 0, 1, 7]),
    )
    for number in range(1, rng.randint(1, 3)):
        layout.schemas[number] = f"Kind{number}", "jsonschema", b"{}" * rng.randint(0, 2)
    for number in rng.sample(range(6), rng.randint(1, 3)):
        schema = rng.choice([0, *layout.schemas])
        topic = rng.choice(["/a", "/b", "/camera/image"])
        layout.channels[number] = topic, schema, {"k": "v"} if rng.random() < 0.3 else {}
    silent = rng.random() < 0.2 and len(layout.channels) > 1
    talking = list(layout.channels)[: -1 if silent else None]
    base = rng.choice([0, 1_000, 10**18])
    undefined = set(layout.channels)

    def message() -> Message:
        time = base + rng.choice([0, 5, rng.randint(0, 100)])
        data = bytes([rng.randint(0, 255)]) * rng.randint(0, 40)
        return Message(rng.choice(talking), time, rng.choice([time, 0]), data, rng.randint(0, 9))

    chunked = rng.random() < 0.85
    for _ in range(rng.randint(0, 4)):
        own = [message() for _ in range(rng.randint(0, 6))]
        new = sorted({m.channel for m in own} & undefined)
        undefined -= set(new)
        if chunked:
            compression = rng.choice(["", "zstd", "lz4"])
            layout.parts.append(Chunk(own, compression, definitions=new))
        else:
            layout.parts += [*new, *own]
    if rng.random() < 0.1:  # messages outside of chunks
        one = message()
        layout.parts += [one.channel, one]
        undefined -= {one.channel}
    extras: list[object] = [{"a": "1"}, {"a": "2", "b": ""}, ("x.bin", "t/x", 5, 6, b"12")]
    for extra in rng.sample(extras, rng.randint(0, 3)):
        layout.parts.insert(rng.randint(0, len(layout.parts)), extra)
    used = {schema for _, schema, _ in layout.channels.values()}
    for number in [n for n in layout.schemas if n not in used]:
        del layout.schemas[number]
    layout.parts += sorted(undefined)  # channels without messages
    return layout
