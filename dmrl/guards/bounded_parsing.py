"""JSON, TOML and NumPy archives of strangers, read within their budgets."""

import json
import lzma
import struct
import tomllib
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.guards import limits


def parse_json(text: str | bytes) -> Any:
    """The value that a JSON document holds.

    Raises
    ------
    ValueError
        If it is no JSON, nests deeper than the budget, or holds a whole number of over 64 bits.
    """
    try:
        return _modest(json.loads(text))
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def parse_toml(text: str) -> dict[str, Any]:
    """The table that a TOML document holds.

    Raises
    ------
    ValueError
        If it is no TOML, is longer than a recipe, nests deeper than the budget, or holds a whole
        number of over 64 bits.
    """
    if len(text) > limits.TOML_CHARACTERS:
        raise ValueError(f"it has {len(text)} characters, more than {limits.TOML_CHARACTERS}")
    try:
        table: dict[str, Any] = _modest(tomllib.loads(text))
        return table
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


LEAKS = (
    *(MemoryError, RuntimeError, LookupError, SyntaxError),
    *(struct.error, zlib.error, lzma.LZMAError),
)
"""What NumPy and zipfile let through of a damaged archive, beside what they say."""
_TOO_DEEP = f"it nests deeper than {limits.DEPTH}"


def _modest(value: Any) -> Any:
    """The value, if it nests no deeper than the budget and its numbers are those of a machine.

    Later code recurses into it, and makes arrays of it.
    """
    level = [value]
    for _ in range(limits.DEPTH):
        if huge := [one for one in level if type(one) is int and one.bit_length() > 64]:
            raise ValueError(f"it holds a whole number of {huge[0].bit_length()} bits")
        containers = [one for one in level if isinstance(one, dict | list)]
        if not containers:
            return value
        level = [
            inner
            for one in containers
            for inner in (one.values() if isinstance(one, dict) else one)
        ]
    raise ValueError(_TOO_DEEP)


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a ``.npz`` file, by name; nothing is unpickled.

    Raises
    ------
    OSError, ValueError, EOFError, zipfile.BadZipFile
        If it is none, or damaged.
    ValueError
        If it unpacks to more than the budget.
    """
    with path.open("rb") as stream:
        with zipfile.ZipFile(stream) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > limits.archive_bytes(path.stat().st_size):
            raise ValueError(f"it unpacks to {size / 1e6:.0f} MB")
        stream.seek(0)
        try:
            with np.load(stream, allow_pickle=False) as arrays:
                return {name: np.asarray(arrays[name]) for name in arrays.files}
        except LEAKS as e:
            raise ValueError(str(e)) from e
