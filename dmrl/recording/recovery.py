"""What could be brought back of a killed or damaged recording."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class Recovery:
    """What was brought back.

    Parameters
    ----------
    messages
        Messages written, bit-exact.
    damaged_chunks
        Chunks within the file that failed their CRC and were left out.
    nameless
        Messages left out because what defines their topic was in a damaged chunk.
    timeless
        Messages left out because their time is beyond the year 2262.
    lost_bytes
        Bytes that are no whole record: after the last one, or before one that is known.
    missing
        Messages that the file had and that were not brought back, by topic, as far as it says.
    counted
        Whether it says so of the whole file: its end, with its statistics, is there.
    doubtful
        Whether metadata or attachments are missing or fail their checksum; what is there is kept
        as it stands.
    whole
        Whether the file has its footer and nothing was lost.
    """

    messages: int = 0
    damaged_chunks: int = 0
    nameless: int = 0
    timeless: int = 0
    lost_bytes: int = 0
    missing: dict[str, int] = field(default_factory=dict)
    counted: bool = False
    doubtful: bool = False
    whole: bool = False
