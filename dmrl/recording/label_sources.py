"""Sources of labels (truth, published, ...), as a PeerLabels message names them.

A source that looked at an image and saw nobody is named as well: no label is then a fact.
"""

from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

LOOKED = ("peers", "sources")
"""Fields of PeerLabels that say who looked."""


def sources_in(peers: pa.Array, sources: pa.Array) -> set[str]:
    """Who looked at any image, by the columns of PeerLabels that `LOOKED` names."""
    named = pc.struct_field(peers.flatten(), "source")
    return {*pc.unique(named).to_pylist(), *pc.unique(sources.flatten()).to_pylist()}


def looked_at(labels: Any) -> set[str]:
    """Who looked at the image of a PeerLabels; empty: not known."""
    return {*labels.sources, *(label.source for label in labels.peers)}
