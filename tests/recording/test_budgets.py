"""Recordings that would take excessive memory are refused before it is allocated."""

import struct
import subprocess
import sys
import zlib
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Schema
from mcap.writer import Writer

from dmrl.guards import limits
from dmrl.messages import serialize_schema
from dmrl.recording.mcap.chunks.chunk import decompress
from dmrl.recording.mcap.file import BudgetError

MAGIC = b"\x89MCAP0\r\n"
HEIGHT = serialize_schema("Height")
SPARE_BYTES = 600_000_000
"""Address space for the refusal, beyond what Python and its libraries hold, bytes."""

READ_BOUNDED = """
import resource, sys
from pathlib import Path
from dmrl.errors import DmrlError
from dmrl.recording import check, read_summary, recover, trim
held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + int(sys.argv[1]), -1))
resource.setrlimit(resource.RLIMIT_CPU, (30, 30))
for path in map(Path, sys.argv[2:]):
    out = path.with_name("out.mcap")
    for read in (check, read_summary, lambda p: trim(p, out), lambda p: recover(p, out)):
        try:
            read(path)
            print("read")
        except DmrlError as e:
            assert not out.exists()
            print(e)
        out.unlink(missing_ok=True)
"""


def read_bounded(*paths: Path, spare: int = SPARE_BYTES) -> list[list[str]]:
    """Return the output of check, info, trim and recover with limited memory and time.

    One list of four lines for each file.
    """
    words = [sys.executable, "-c", READ_BOUNDED, str(spare), *map(str, paths)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    output = done.stdout.splitlines()
    assert len(output) == 4 * len(paths)
    return [output[k : k + 4] for k in range(0, len(output), 4)]


def build_zstd_bomb(size: int, *, telling: bool = True) -> bytes:
    """Build a zstd frame of zero bytes: each block of 128 KiB takes four bytes.

    The frame states its decompressed size if ``telling``.
    """
    header = struct.pack("<IBB", 0xFD2FB528, 0xC0 * telling, 7 << 3)
    header += struct.pack("<Q", size) * telling
    blocks = [b"\x02\x00\x10\x00"] * (size >> 17)
    blocks[-1] = b"\x03\x00\x10\x00"
    return header + b"".join(blocks)


def write_chunks(path: Path, *chunks: Chunk) -> Path:
    """Write a complete recording of these chunks, without a summary."""
    builder = RecordBuilder()
    Header("", "").write(builder)
    Schema(1, HEIGHT, "protobuf", "dmrl.v1.Height").write(builder)
    Channel(1, "/cf1/height", "protobuf", {}, 1).write(builder)
    for chunk in chunks:
        chunk.write(builder)
    DataEnd(0).write(builder)
    Footer(0, 0, 0).write(builder)
    path.write_bytes(MAGIC + builder.end() + MAGIC)
    return path


def build_chunk(data: bytes, size: int, compression: str = "zstd") -> Chunk:
    """Build a chunk of compressed data that states this uncompressed size, bytes."""
    return Chunk(compression, data, 1, 0, 0, size)


def test_zstd_bomb_helper_writes_valid_frames() -> None:
    for telling in (True, False):
        frame = build_zstd_bomb(1 << 20, telling=telling)
        assert zstandard.ZstdDecompressor().decompress(frame, 1 << 20) == bytes(1 << 20)


@pytest.mark.heavy
def test_bombs_are_refused(tmp_path: Path) -> None:
    bombs = {
        "true size": build_chunk(build_zstd_bomb(6 << 30), 6 << 30),
        "false size": build_chunk(build_zstd_bomb(6 << 30), 1000),
        "no size": build_chunk(build_zstd_bomb(6 << 30), 0),
        "a frame without size": build_chunk(build_zstd_bomb(6 << 30, telling=False), 1000),
        "lz4": build_chunk(lz4.frame.compress(bytes(1 << 28)), 1000, "lz4"),
    }
    paths = [write_chunks(tmp_path / f"{name}.mcap", bomb) for name, bomb in bombs.items()]
    assert all(path.stat().st_size < 2_000_000 for path in paths)
    for name, (*read, recovered) in zip(bombs, read_bounded(*paths), strict=True):
        # A stated size is refused by the limit, not by lack of memory in this process.
        words = "is damaged" if name == "a frame without size" else "decompresses to"
        assert all(words in said for said in read), (name, read)
        assert "nothing to recover" in recovered, name


def test_decompressed_chunk_size_is_limited_in_any_file() -> None:
    """The limit is per chunk: a file may hold many chunks."""
    with pytest.raises(BudgetError, match="the chunk at byte 8 decompresses to 268 MB"):
        decompress(build_chunk(build_zstd_bomb(1 << 28), 1 << 28), 8)


@pytest.mark.heavy
def test_many_small_bombs_are_refused(tmp_path: Path) -> None:
    size = 100_000_000
    data = struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + size, 1, 0, 0, 0) + bytes(size)
    one = Chunk("zstd", zstandard.compress(data), 0, 0, zlib.crc32(data), len(data))
    path = write_chunks(tmp_path / "bomb.mcap", *[one] * 50)
    (said,) = read_bounded(path)
    assert all("it decompresses to" in line for line in said), said


@pytest.mark.slow
def test_chunk_with_most_messages_is_read_within_the_budget(tmp_path: Path) -> None:
    message = struct.pack("<BQHIQQ", Opcode.MESSAGE, 22, 1, 0, 0, 0)
    data = message * (limits.UNPACKED_BYTES // len(message))
    one = Chunk("zstd", zstandard.compress(data), 0, 0, zlib.crc32(data), len(data))
    path = write_chunks(tmp_path / "many.mcap", one)
    assert read_bounded(path, spare=1_000_000_000) == [["read"] * 4]


@pytest.mark.heavy
def test_an_indexed_bomb_is_refused(tmp_path: Path) -> None:
    """The summary of a complete file states the size of its chunks."""
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 20)
        writer.start()
        schema = writer.register_schema("dmrl.v1.Height", "protobuf", HEIGHT)
        channel = writer.register_channel("/cf1/height", "protobuf", schema)
        for k in range(400):
            writer.add_message(channel, k, bytes(1 << 20), k)
        writer.finish()
    assert path.stat().st_size < 1_000_000
    (said,) = read_bounded(path)
    assert all("compress" in line or "unpack" in line for line in said), said


def register_too_many_topics(writer: Writer) -> None:
    for k in range(limits.TOPICS + 1):
        writer.register_channel(f"/cf{k}/height", "protobuf", 1)


def register_too_long_name(writer: Writer) -> None:
    writer.register_channel("/" + "a" * limits.NAME_CHARACTERS, "protobuf", 1)


@pytest.mark.heavy
def test_topics_and_names_have_a_budget(tmp_path: Path) -> None:
    paths = [tmp_path / "topics.mcap", tmp_path / "name.mcap"]
    for path, fill in zip(paths, (register_too_many_topics, register_too_long_name), strict=True):
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            writer.register_schema("dmrl.v1.Height", "protobuf", HEIGHT)
            fill(writer)
            writer.add_message(1, 0, b"", 0)
            writer.finish()
    topics, name = read_bounded(*paths)
    assert "2000 channels" in topics[0]
    assert "1001 characters" in name[0]
