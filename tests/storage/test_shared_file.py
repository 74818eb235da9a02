"""Readers that share one open file, each with its own position, and damaged reads."""

import hashlib
import io
import os
from pathlib import Path

import pytest

from dmrl.errors import RecordingError
from dmrl.storage.shared_file import hash_file, open_raw, share_file


def test_readers_of_one_file_have_their_own_positions(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(range(100)))
    with share_file(path), share_file(path):
        path.unlink()  # proves that the file is not opened again
        one, other = open_raw(path), open_raw(path)
        assert one.read(3) == bytes([0, 1, 2])
        assert other.seek(-2, 2) == 98
        assert (one.seek(1, 1), one.tell(), one.read(1)) == (4, 4, bytes([4]))
        assert other.read() == bytes([98, 99])
    assert one.read(1) == bytes([5])  # a reader stays usable after the block
    one.close()
    other.close()
    with pytest.raises(FileNotFoundError):
        open_raw(path)


def test_sharing_a_missing_file_raises_on_open_only(tmp_path: Path) -> None:
    with share_file(tmp_path / "none"), pytest.raises(FileNotFoundError):
        open_raw(tmp_path / "none")


def flip_reads(monkeypatch: pytest.MonkeyPatch, calls: range) -> None:
    """Flip a bit in the first byte of these calls of ``os.pread``, counted from 0."""
    real, count = os.pread, [0]

    def pread(descriptor: int, size: int, at: int) -> bytes:
        data = real(descriptor, size, at)
        count[0] += 1
        if count[0] - 1 in calls:
            return bytes([data[0] ^ 1]) + data[1:]
        return data

    monkeypatch.setattr(os, "pread", pread)


@pytest.mark.parametrize("name", ["a.mcap", "model.bin"])
def test_a_flipped_read_while_hashing_is_noticed(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / name
    path.write_bytes(bytes(200_000))
    flip_reads(monkeypatch, range(1, 2))  # the second block while hashing
    with pytest.raises(RecordingError, match=r"two reads of byte 65536 and later differ"):
        hash_file(path)
        with open_raw(path) as stream:
            stream.read()


def test_a_flipped_read_of_the_data_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(os.urandom(200_000))
    flip_reads(monkeypatch, range(5, 6))
    assert hash_file(path) == hashlib.sha256(path.read_bytes()).hexdigest()
    with io.BufferedReader(open_raw(path)) as stream:
        assert stream.read() == path.read_bytes()
        assert stream.seek(131_000) and stream.read(100) == path.read_bytes()[131_000:131_100]


def test_a_file_that_was_replaced_is_not_compared(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"before")
    hash_file(path)
    path.write_bytes(b"another")
    with open_raw(path) as stream:
        assert stream.read() == b"another"
