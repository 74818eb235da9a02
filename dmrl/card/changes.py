"""Compare two datasets, such as one before and after recordings were added."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from dmrl.card import read_provenance_file
from dmrl.card.describe import describe_dataset
from dmrl.datasets import open_dataset


class Change(NamedTuple):
    """A quantity of a card that differs between two datasets; None where it is missing."""

    what: str
    before: Any
    now: Any


def compare_datasets(folder: Path, old: Path) -> list[Change]:
    """Compare the images, peers, splits, robots, recordings, labels and settings of two datasets.

    Parameters
    ----------
    folder, old
        The dataset, and the one before.

    Returns
    -------
    list[Change]
        The quantities that differ; empty for equal datasets.

    Raises
    ------
    DatasetError
        If a folder is not a dataset, or lacks a shard or its provenance.
    """
    before, now = (dict(_iter_quantities(path)) for path in (old, folder))
    found = (Change(what, before.get(what), now.get(what)) for what in {**before, **now})
    return [one for one in found if one.before != one.now]


def _iter_quantities(folder: Path) -> Iterator[tuple[str, Any]]:
    about = describe_dataset(open_dataset(folder), read_provenance_file(folder))
    for name in ("version", "images", "width", "height"):
        yield name, about[name]
    yield "images without a peer", about["empty"]
    yield "largest number of peers in an image", about["most"]
    yield "robots with a camera", _join_names(about, lambda table: table["robot"])
    yield (
        "names of peers",
        _join_names(about, lambda table: pc.struct_field(pc.list_flatten(table["peers"]), "peer")),
    )
    for name, counts in about["counts"].items():
        yield f"images in {name}", counts.images
        yield f"peers inside the images in {name}", int(counts.peers.sum())
        for source, n in sorted(counts.label_sources.items()):
            yield f"labels from {source} in {name}", n
    for recording, name, n in about["recordings"]:
        yield f"images of {recording} in {name}", n
    for status, n in sorted(about["statuses"].items()):
        yield f"labels that are {status}", n
    for share, depth_m in zip((5, 50, 95), about["spread"] or (), strict=False):
        yield f"depth, {share} % of the peers are nearer, m", round(depth_m, 3)
    for source, (known, _, *medians) in about["sigmas"].items():
        yield f"labels from {source} with a sigma", known
        for unit, median in zip(("u, px", "v, px", "depth, m"), medians, strict=True):
            yield f"median sigma from {source} in {unit}", round(median, 3)
    for key, value in sorted(about["made"].settings.items()):
        yield f"setting {key}", str(value)


def _join_names(about: Mapping[str, Any], column: Callable[[pa.Table], Any]) -> str:
    """Return the names in a column of all splits."""
    columns = (column(split.table) for split in about["splits"].values())
    names = {name for one in columns for name in pc.unique(one).to_pylist()}
    return ", ".join(sorted(names))
