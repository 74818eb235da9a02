"""Wrong offsets in the summary give an error or no loss, even if every CRC is correct."""

import struct
import zlib
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from dmrl.recording import read_summary, recover

from ..faults import parts
from ..faults.ending import run_to_end
from ..faults.inputs import Inputs, cli

pytestmark = pytest.mark.heavy
FIELDS = {
    Opcode.CHUNK_INDEX: (16, 24),
    Opcode.ATTACHMENT_INDEX: (0, 8),
    Opcode.METADATA_INDEX: (0, 8),
    Opcode.SUMMARY_OFFSET: (1, 9),
}
"""Byte offsets of two numbers in each record: an offset in the file, and a length or size."""
FOOTER = 9 + 20 + len(parts.MAGIC)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording with chunks, attachments and metadata."""
    return Inputs(tmp_path_factory.mktemp("inputs")).flight


def replace_offset(data: bytes, opcode: int, at: int, offset: int) -> bytes:
    """Return the recording with the number at byte ``at`` of a summary record replaced.

    The record is the first one of this opcode. The summary's CRC is computed again.
    """
    end = len(data) - FOOTER
    start = struct.unpack_from("<Q", data, end + 9)[0]
    records, starts = parts.split_records(data, start, end)
    first = next(s for (kind, _), s in zip(records, starts, strict=True) if kind == opcode)
    out = bytearray(data)
    struct.pack_into("<Q", out, first + 9 + at, offset)
    crc = zlib.crc32(out[start : end + 9 + 16])
    struct.pack_into("<I", out, end + 9 + 16, crc)
    return bytes(out)


@pytest.mark.parametrize("offset", ["past", "end", 2**62, 2**64 - 1, 0])
@pytest.mark.parametrize("opcode", FIELDS, ids=lambda opcode: Opcode(opcode).name)
def test_invalid_offset_gives_one_line_error_and_loses_nothing(
    opcode: Opcode, offset: int | str, sound: Path, tmp_path: Path
) -> None:
    data = sound.read_bytes()
    number = {"past": len(data) + 1000, "end": len(data) - 1}.get(str(offset), offset)
    assert isinstance(number, int)
    bad, out = tmp_path / "bad.mcap", tmp_path / "out.mcap"
    for at in FIELDS[opcode]:
        bad.write_bytes(replace_offset(data, opcode, at, number))
        for command in ("info", "check"):
            status, output = run_to_end(lambda c=command: cli(c, bad))
            assert status == 0 or "bad.mcap" in output
        status, output = run_to_end(lambda: cli("trim", bad, out))
        assert (status == 0) == out.exists() and (status == 0 or "dmrl recover" in output), output
        if status == 0:
            assert read_summary(out).topics == read_summary(sound).topics
            out.unlink()
        recover(bad, out)
        assert read_summary(out).topics == read_summary(sound).topics
        out.unlink()
