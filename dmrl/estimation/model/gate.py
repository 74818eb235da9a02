"""Gate of the positions that are precise enough. Imports nothing heavy: help shows the values."""

from dataclasses import dataclass

GATE_M, BAD_SHARE = 0.3, 0.02
"""Defaults: largest horizontal error of a good position, metres; and largest expected share of bad
positions among those that are kept. No record of how the error was chosen."""


@dataclass(frozen=True, slots=True)
class Gate:
    """Gate of a flight's positions.

    Parameters
    ----------
    error_m
        Largest error of a good position, metres.
    bad_share
        Largest expected share of bad positions among the kept ones.
    """

    error_m: float = GATE_M
    bad_share: float = BAD_SHARE


DEFAULT_GATE = Gate()
