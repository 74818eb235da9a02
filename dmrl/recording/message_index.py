"""Message indexes: where in a chunk the messages of each channel stand, and their times."""

from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from dmrl.recording.block import Ints
from dmrl.recording.container import INDEX
from dmrl.recording.opening import damaged


def index_entries(path: Path, raw: bytes, at: int, number: int) -> bytes:
    """Entries of one channel's message index that stands there."""
    opcode, length, channel, size = INDEX.unpack_from(raw, at)
    if (opcode, length, channel) != (Opcode.MESSAGE_INDEX, size + 6, number) or size % 16:
        raise damaged(path, f"message index of channel {number} is wrong")
    entries = raw[at + INDEX.size : at + INDEX.size + size]
    if len(entries) < size:
        raise damaged(path, f"message index of channel {number} is cut")
    return entries


def as_pairs(raw: bytes) -> Ints:
    """(N, 2) log times and offsets."""
    return np.frombuffer(raw, "<i8").reshape(-1, 2).astype(np.int64)
