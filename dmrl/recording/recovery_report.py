"""Define the report about a recovered recording."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class Recovery:
    """Report about a recovered recording.

    Parameters
    ----------
    messages
        Messages written, bit-exact.
    damaged_chunks
        Chunks that were left out because they failed their CRC.
    nameless
        Messages left out because the definition of their topic was in a corrupt chunk.
    timeless
        Messages left out because their time is beyond the year 2262.
    lost_bytes
        Bytes outside of complete records: after the last one, or before the next listed one.
    missing
        Messages that were not recovered, by topic, as far as the file lists them. Their topic is
        "unknown" where the file states only how many there were.
    counted
        Whether ``missing`` covers the whole file: its Statistics record was readable.
    contradictions
        What the file states about itself that is not so, a phrase each.
    doubtful
        Whether metadata or attachments are missing or fail their checksum. They are kept as they
        are.
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
    contradictions: list[str] = field(default_factory=list)
    doubtful: bool = False
    whole: bool = False
