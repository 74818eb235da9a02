"""List the label sources (truth, published, ...) that a PeerLabels message names.

A source that labelled an image without peers is listed as well: the absence is then certain.
"""

from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

SOURCE_FIELDS = ("peers", "sources")
"""Fields of PeerLabels that contain sources."""


def collect_sources(peers: pa.Array, sources: pa.Array) -> set[str]:
    """Return the sources in the columns `SOURCE_FIELDS` of PeerLabels."""
    named = pc.struct_field(peers.flatten(), "source")
    return {*pc.unique(named).to_pylist(), *pc.unique(sources.flatten()).to_pylist()}


def get_message_sources(labels: Any) -> set[str]:
    """Return the sources of one PeerLabels message; empty if they are unknown."""
    return {*labels.sources, *(label.source for label in labels.peers)}
