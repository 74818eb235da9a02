"""Parse numbers, JSON, TOML, YAML, XML and NumPy archives of untrusted files within limits."""

import json
import lzma
import struct
import tokenize
import tomllib
import zipfile
import zlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from dmrl.guards import limits
from dmrl.guards.memory import MemoryLimit


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON document.

    Raises
    ------
    ValueError
        If it is not JSON, nests deeper than the limit, or contains an integer over 64 bits.
    """
    try:
        return _check_limits(json.loads(text))
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return the table of a TOML document.

    Raises
    ------
    ValueError
        If it is not TOML, exceeds the limit of characters or depth, or contains an integer over
        64 bits.
    """
    if len(text) > limits.TOML_CHARACTERS:
        raise ValueError(f"it has {len(text)} characters, more than {limits.TOML_CHARACTERS}")
    try:
        with MemoryLimit(len(text)):  # a key of many parts needs their number squared
            table: dict[str, Any] = _check_limits(tomllib.loads(text))
        return table
    except (RecursionError, MemoryError):
        raise ValueError(_TOO_DEEP) from None


def parse_yaml(text: str) -> dict[str, Any]:
    """Return the table of a YAML document without aliases, which can multiply its size.

    Raises
    ------
    ValueError
        If it is not a YAML table, has aliases, or exceeds the limit of characters or depth.
    ModuleNotFoundError
        If PyYAML is not installed.
    """
    import yaml  # noqa: PLC0415 - an extra

    if len(text) > limits.TOML_CHARACTERS:
        raise ValueError(f"it has {len(text)} characters, more than {limits.TOML_CHARACTERS}")
    try:
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader)):
            raise ValueError("it has aliases")
        table = _check_limits(yaml.safe_load(text))
    except (yaml.YAMLError, RecursionError) as e:
        raise ValueError(str(e)) from None
    if not isinstance(table, dict):
        raise ValueError("it is not a table of keys")
    return table


def parse_xml(data: bytes) -> ElementTree.Element:
    """Return the root of an XML document without entities, which can multiply its size.

    Raises
    ------
    ValueError
        If it is not XML, defines entities, or exceeds the limit of characters.
    """
    most = limits.XML_BYTES
    if len(data) > most or b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise ValueError(f"it is over {most} bytes, or defines entities")
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as e:
        raise ValueError(str(e)) from None


def parse_number(text: str) -> float:
    """Parse a number; raise ValueError if it is none. To Python alone, ``1_0`` is one, too."""
    if "_" in text:
        raise ValueError(f"{text!r} is no number")
    return float(text)


ARCHIVE_ERRORS = (
    *(MemoryError, RuntimeError, LookupError, SyntaxError, TypeError, EOFError),
    *(struct.error, zlib.error, lzma.LZMAError, zipfile.BadZipFile, tokenize.TokenError),
)
"""Errors that NumPy and zipfile raise on corrupt archives beside the documented ones."""
_TOO_DEEP = f"it nests deeper than {limits.DEPTH}"


def _check_limits(value: Any) -> Any:
    """Return the value if its depth and its integers are within the limits.

    Later code recurses into it, and makes arrays of it.
    """
    level = [value]
    for _ in range(limits.DEPTH):
        if huge := [one for one in level if type(one) is int and one.bit_length() > 64]:
            raise ValueError(f"it contains an integer of {huge[0].bit_length()} bits")
        containers = [one for one in level if isinstance(one, dict | list)]
        if not containers:
            return value
        rows = (one.values() if isinstance(one, dict) else one for one in containers)
        level = [inner for row in rows for inner in row]
    raise ValueError(_TOO_DEEP)


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a ``.npz`` file by name, without unpickling.

    Raises
    ------
    OSError, ValueError, EOFError, zipfile.BadZipFile
        If it is not an archive, or is corrupt.
    ValueError
        If it decompresses to more than the limit.
    """
    with path.open("rb") as stream:
        with zipfile.ZipFile(stream) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > limits.max_archive_bytes(path.stat().st_size):
            raise ValueError(f"it decompresses to {size / 1e6:.0f} MB")
        stream.seek(0)
        try:
            with np.load(stream, allow_pickle=False) as arrays:
                return {name: np.asarray(arrays[name]) for name in arrays.files}
        except ARCHIVE_ERRORS as e:
            raise ValueError(str(e)) from e
