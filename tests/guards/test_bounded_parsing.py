"""Untrusted documents and arrays that would take excessive memory raise a ValueError first."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from dmrl.guards.bounded_parsing import load_npz, parse_json, parse_toml


def test_documents_are_read() -> None:
    assert parse_json('{"a": [1, {"b": null}]}') == {"a": [1, {"b": None}]}
    assert parse_toml("a.b = [1]") == {"a": {"b": [1]}}


@pytest.mark.parametrize("depth", [201, 5_000, 1_000_000])
def test_nesting_has_a_budget(depth: int) -> None:
    for text in ("[" * depth + "]" * depth, '{"a":' * depth + "1" + "}" * depth):
        with pytest.raises(ValueError, match="nests deeper than 200"):
            parse_json(text)


def test_deepest_allowed_nesting_is_read() -> None:
    assert parse_json("[" * 199 + "]" * 199) is not None


@pytest.mark.parametrize("number", [2**64, -(2**64), 10**400])
def test_whole_numbers_have_64_bits(number: int) -> None:
    """`float` and NumPy would raise other exceptions for larger integers."""
    for text in (f"[{number}]", f'{{"a": {{"b": [1, {number}]}}}}'):
        with pytest.raises(ValueError, match="an integer of"):
            parse_json(text)
    with pytest.raises(ValueError, match="an integer of"):
        parse_toml(f"a.b = {number}")
    assert parse_json("[18446744073709551615, true, 1e300]") == [2**64 - 1, True, 1e300]


def test_arrays_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, one=np.arange(5), two=np.zeros((2, 3)))
    found = load_npz(path)
    assert found["one"].tolist() == [0, 1, 2, 3, 4]
    assert found["two"].shape == (2, 3)


@pytest.mark.heavy
def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(3):
            archive.writestr(f"{k}.npy", bytes(50 << 20))
    assert path.stat().st_size < 200_000
    with pytest.raises(ValueError, match="it decompresses to 157 MB"):
        load_npz(path)


def test_array_with_oversized_header_is_refused(tmp_path: Path) -> None:
    header = io.BytesIO()
    shape = {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**7)}
    np.lib.format.write_array_header_1_0(header, shape)
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", header.getvalue() + bytes(80))
    with pytest.raises(ValueError):
        load_npz(path)


@pytest.mark.parametrize(
    "kind", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
)
def test_a_damaged_archive_of_any_compression_is_refused(kind: int, tmp_path: Path) -> None:
    array = io.BytesIO()
    np.save(array, np.random.default_rng(0).integers(0, 9, 500, np.uint8))
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", kind) as archive:
        archive.writestr("a.npy", array.getvalue())
    assert len(load_npz(path)["a"]) == 500
    data = bytearray(path.read_bytes())
    for at in (60, 100, 150):
        for value in (0, 1, 255):
            path.write_bytes(data[:at] + bytes([value]) * 20 + data[at + 20 :])
            with pytest.raises((ValueError, OSError, EOFError, zipfile.BadZipFile)):
                load_npz(path)


def test_archive_member_is_read_up_to_its_stated_size(tmp_path: Path) -> None:
    """The directory of an archive may state a smaller size than its member has."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(10 << 20))
    data = bytearray(path.read_bytes())
    at = data.rindex(b"PK\x01\x02") + 24
    data[at : at + 4] = (100).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises((ValueError, zipfile.BadZipFile)):
        load_npz(path)
