"""One thing wrong with a recording."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing wrong with a recording.

    Parameters
    ----------
    level
        "error" or "warning".
    topic
        Where; empty for the recording as a whole.
    text
        What, in one line.
    """

    level: Literal["error", "warning"]
    topic: str
    text: str
