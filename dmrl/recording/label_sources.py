"""List the label sources (truth, published, ...) that a PeerLabels message names.

A source that labelled an image without peers is listed as well: the absence is then certain. Two
recordings of the same images, merged, have several messages at the time of an image.
"""

from collections.abc import Hashable, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from dmrl.errors import RecordingError

SOURCE_FIELDS = ("peers", "sources")
"""Fields of PeerLabels that contain sources."""


def collect_sources(peers: pa.Array, sources: pa.Array) -> set[str]:
    """Return the sources in the columns `SOURCE_FIELDS` of PeerLabels."""
    named = pc.struct_field(peers.flatten(), "source")
    return {*pc.unique(named).to_pylist(), *pc.unique(sources.flatten()).to_pylist()}


def get_message_sources(labels: Any) -> set[str]:
    """Return the sources of one PeerLabels message; empty if they are unknown."""
    return {*labels.sources, *(label.source for label in labels.peers)}


def mark_repeated(
    messages: Sequence[Sequence[tuple[tuple[str, str], Hashable]]], where: str
) -> list[list[bool]]:
    """Return whether each label of an image's messages is in an earlier message already.

    Parameters
    ----------
    messages
        Peer and source, and content, of each label of each message.
    where
        Topic and time, for errors.

    Raises
    ------
    RecordingError
        If two messages have different labels of one peer from one source.
    """
    earlier: dict[tuple[str, str], set[Hashable]] = {}
    marked = []
    for labels in messages:
        for (peer, source), content in labels:
            if peer and content not in earlier.get((peer, source), {content}):
                raise RecordingError(
                    f"{where} has different labels of {peer} from {source}, as in a merge of two "
                    "flights or labellings. Give the recordings one by one"
                )
        marked.append([content in earlier.get(key, ()) for key, content in labels])
        for key, content in labels:
            earlier.setdefault(key, set()).add(content)
    return marked
