"""Log blocks, time series of their variables, and unpacking of compressed quaternions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl.geometry.frames import Array
from dmrl.samples.flight import Times


@dataclass(frozen=True, slots=True)
class LogBlock:
    """Variables that were logged together.

    Parameters
    ----------
    name
        Name of the event or log block.
    time_ns
        (N,) nanoseconds.
    columns
        (N,) values of each variable, by name, in the type in which they were logged.
    """

    name: str
    time_ns: Times
    columns: Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class TimeSeries:
    """Values over time: (N,) nanoseconds and (N, C) float64."""

    time_ns: Times
    values: Array

    def select_column(self, column: int) -> "TimeSeries":
        """Return one of the values as a series, (N, 1)."""
        return TimeSeries(self.time_ns, self.values[:, [column]])

    def interpolate(self, time_ns: Times) -> Array:
        """Interpolate (M, C) values at other times: linear, constant before and after."""
        if np.array_equal(time_ns, self.time_ns):
            return self.values  # also where rows share a time
        return np.stack([np.interp(time_ns, self.time_ns, v) for v in self.values.T], axis=1)


def unwrap_between_blocks(blocks: Sequence[LogBlock], period_ns: int) -> list[LogBlock]:
    """Add missing wraps: blocks may start on different sides of a wrap of the clock.

    Parameters
    ----------
    blocks
        Blocks of one robot, each unwrapped.
    period_ns
        Nanoseconds after which the clock wraps.
    """
    wraps = [round((blocks[0].time_ns[0] - block.time_ns[0]) / period_ns) for block in blocks]
    return [  # relative to the earliest, so that no time is before 0
        replace(block, time_ns=block.time_ns + (count - min(wraps)) * period_ns)
        for block, count in zip(blocks, wraps, strict=True)
    ]


def find_series(blocks: Sequence[LogBlock], names: Sequence[str]) -> TimeSeries | None:
    """Return the finite rows of the first block that has some under all these names; or None."""
    for block in blocks:
        if all(name in block.columns for name in names):
            values = np.stack([block.columns[name].astype(float) for name in names], axis=1)
            good = np.isfinite(values).all(axis=1)
            if good.any():
                return TimeSeries(block.time_ns[good], values[good])
    return None


def unpack_quaternions(packed: NDArray[np.int64]) -> Array:
    """Return (N, 4) x, y, z, w of the firmware's 32-bit quaternions.

    Two bits give the index of the largest component, which is omitted and positive. The others
    follow in order, ten bits each: the sign, and nine bits of magnitude in units of sqrt(1/2).
    """
    packed = packed & 0xFFFFFFFF
    largest = packed >> 30
    out = np.zeros((len(packed), 4))
    left = packed.copy()
    for k in (3, 2, 1, 0):
        use = largest != k
        value = (left & 0x1FF) / 511 * np.sqrt(0.5) * np.where(left & 0x200, -1.0, 1.0)
        out[use, k] = value[use]
        left = np.where(use, left >> 10, left)
    rest = np.sqrt(np.clip(1 - (out**2).sum(axis=1), 0, None))
    out[np.arange(len(out)), largest] = rest
    return out
