"""Messages over a pipe: a JSON head and raw arrays, each preceded by its length.

Imported by dmrl and by the worker in Blender's Python. Therefore only the standard library and
NumPy are used.
"""

import json
import struct
from collections.abc import Mapping
from typing import IO, Any

import numpy as np

_LENGTH = struct.Struct("<Q")

Arrays = dict[str, np.ndarray[Any, np.dtype[Any]]]


def send(stream: IO[bytes], head: Mapping[str, Any], arrays: Arrays | None = None) -> None:
    """Write one message.

    Parameters
    ----------
    stream
        Stream to write to.
    head
        JSON values.
    arrays
        Arrays, sent as they lie in memory, little-endian.
    """
    arrays = {} if arrays is None else {k: np.ascontiguousarray(v) for k, v in arrays.items()}
    shapes = {name: (a.dtype.str, list(a.shape)) for name, a in arrays.items()}
    text = json.dumps({"head": dict(head), "arrays": shapes}).encode()
    stream.write(_LENGTH.pack(len(text)) + text)
    for array in arrays.values():
        stream.write(array.tobytes())
    stream.flush()


def receive(stream: IO[bytes]) -> tuple[dict[str, Any], Arrays]:
    """Read the head and the arrays of one message.

    Raises
    ------
    EOFError
        If the other side closed the pipe.
    """
    (length,) = _LENGTH.unpack(_receive_exactly(stream, _LENGTH.size))
    message = json.loads(_receive_exactly(stream, length))
    arrays: Arrays = {}
    for name, (dtype, shape) in message["arrays"].items():
        kind = np.dtype(dtype)
        data = _receive_exactly(stream, kind.itemsize * int(np.prod(shape)))
        arrays[name] = np.frombuffer(data, kind).reshape(shape)
    return message["head"], arrays


def _receive_exactly(stream: IO[bytes], count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = stream.read(count - len(data))
        if not part:
            raise EOFError("the other side closed the pipe")
        data += part
    return data
