"""Define a finding of a check."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Finding:
    """A problem of a recording.

    Parameters
    ----------
    level
        "error" or "warning".
    topic
        Topic with the problem; empty for the recording as a whole.
    text
        Description in one line.
    """

    level: Literal["error", "warning"]
    topic: str
    text: str
