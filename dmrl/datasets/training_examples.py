"""Load training data from datasets: images, their robots, and the validation part."""

import fnmatch
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl.datasets import Dataset, Split
from dmrl.errors import DatasetError, SettingError
from dmrl.learn.data.batches import BOX, CLASS_ID, ROBOT_FIELDS, ExampleSet
from dmrl.learn.training.config import TrainConfig


class TrainingData(NamedTuple):
    """Images to train on, images to validate on, and sampling weights.

    Parameters
    ----------
    examples
        Training images.
    held_out
        Validation images, on which the threshold is chosen: the split val or, without one, a share
        of the train split. None: nothing is held out.
    shares
        (N,) mean number of times that each of ``examples`` is drawn in an epoch, 1 on average.
        None: each once.
    sources
        (N,) number of the recording of each image of ``held_out``.
    """

    examples: ExampleSet
    held_out: ExampleSet | None
    shares: NDArray[np.float64] | None
    sources: NDArray[np.int64] | None


def load_training_data(data: Dataset, settings: TrainConfig) -> TrainingData:
    """Load the training and the validation images that these settings choose.

    Raises
    ------
    DatasetError
        If the dataset has no train split, or that split no robot.
    SettingError
        If the shares do not match the recordings, or the classes the peers.
    """
    train = data.split("train")
    every = build_examples(train, settings.classes)
    if not np.isfinite(every.robots).any():
        raise DatasetError(
            f"{data.path} shows no robot in any of the {len(every)} images of its train split: a "
            "network would learn to detect none. Add images with robots: dmrl dataset "
            f"ROBOTS.mcap {data.path} --add"
        )
    _require_classes(train, every, settings.classes)
    sources = np.array(train.table.column("source").to_pylist())
    held = np.zeros(len(every), bool)
    watched, watched_sources = None, sources[:0]
    if "val" in data.splits:
        val = data.split("val")
        watched = build_examples(val, settings.classes)
        watched_sources = np.array(val.table.column("source").to_pylist())
    elif settings.validation_share:
        held = _select_last_share(sources, settings.validation_share)
        watched = every.select(held) if held.any() else None
        watched_sources = sources[held]
    learnt = every.select(~held) if held.any() else every
    weights = _compute_sample_weights(sources[~held], settings.shares)
    numbers = np.unique(watched_sources, return_inverse=True)[1] if watched is not None else None
    return TrainingData(learnt, watched, weights, numbers)


def _require_classes(train: Split, every: ExampleSet, classes: Sequence[str]) -> None:
    for number, pattern in enumerate(classes):
        if not (every.robots[..., CLASS_ID] == number).any():
            peers = pc.list_flatten(train.table.column("peers"))
            names = pc.unique(pc.struct_field(peers, "peer")).to_pylist()
            raise SettingError(
                f"classes: {pattern} matches no peer that the patterns before it leave. Choose "
                f"among {', '.join(sorted(names))}"
            )


def _select_last_share(sources: NDArray[np.str_], share: float) -> NDArray[np.bool_]:
    """Select the last share of the images of each recording."""
    held = np.zeros(len(sources), bool)
    for source in np.unique(sources):
        mine = np.flatnonzero(sources == source)
        held[mine[len(mine) - int(share * len(mine)) :]] = True
    return held


def _compute_sample_weights(
    sources: NDArray[np.str_], wanted: dict[str, float]
) -> NDArray[np.float64] | None:
    """Return how often each image is drawn in an epoch, from the shares of the recordings.

    Raises
    ------
    SettingError
        If a pattern matches no recording, or no pattern matches a recording.
    """
    if not wanted:
        return None
    out = np.full(len(sources), np.nan)
    names = sorted(set(sources.tolist()))
    for pattern, share in wanted.items():
        mine = np.isin(sources, fnmatch.filter(names, pattern)) & np.isnan(out)
        if not mine.any():
            raise SettingError(
                f"shares: no images left for {pattern}. The recordings are {', '.join(names)}"
            )
        out[mine] = share / mine.sum()
    if np.isnan(out).any():
        forgotten = sources[np.isnan(out)][0]
        raise SettingError(f'shares: none for {forgotten}. Name it, or add "*"')
    if not out.sum():
        raise SettingError("shares: all are 0. Give one that is not")
    shares: NDArray[np.float64] = out / out.mean()
    return shares


def build_examples(split: Split, classes: Sequence[str] = ()) -> ExampleSet:
    """Build training examples from a split; ``classes`` are patterns of peer names."""
    column = split.table.column("peers").combine_chunks()
    counts = pc.list_value_length(column).to_numpy(zero_copy_only=False).astype(np.int64)
    peers = column.flatten()
    flat = np.full((len(peers), len(ROBOT_FIELDS)), np.nan, np.float32)
    for index, name in enumerate(ROBOT_FIELDS[:6]):
        flat[:, index] = pc.struct_field(peers, name).to_numpy(zero_copy_only=False)
    boxes = pc.struct_field(peers, "box_px")
    boxed = pc.list_value_length(boxes).to_numpy(zero_copy_only=False) == 4
    corners = boxes.filter(pa.array(boxed)).flatten().to_numpy(zero_copy_only=False)
    flat[np.ix_(boxed, range(*BOX.indices(len(ROBOT_FIELDS))))] = corners.reshape(-1, 4)
    flat[:, CLASS_ID] = _assign_class_ids(pc.struct_field(peers, "peer"), classes)
    robots = np.full((len(counts), max(int(counts.max(initial=0)), 1), len(ROBOT_FIELDS)), np.nan)
    image = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(flat)) - np.repeat(np.cumsum(counts) - counts, counts)
    robots[image, place] = flat
    return ExampleSet(split.pixels, robots.astype(np.float32), split.masks, split.require_whole)


def _assign_class_ids(names: pa.Array, classes: Sequence[str]) -> NDArray[np.float32]:
    """Return the first matching pattern of each peer's name, (n,); NaN without a match."""
    known = pc.unique(names).to_pylist()
    place = np.array(pc.index_in(names, pa.array(known, names.type)).to_pylist(), np.int64)
    of_name = np.full(len(known), np.nan, np.float32)
    for k in reversed(range(len(classes))):
        of_name[[fnmatch.fnmatchcase(name, classes[k]) for name in known]] = k
    return of_name[place]
