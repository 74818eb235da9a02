"""Shuffled batches out of images that stay where they are.

The images of a dataset are a list of arrays mapped from its files. A batch is gathered into
one reused buffer: one copy per image, no allocation, still uint8.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class Batch(NamedTuple):
    """Views of a reused buffer: use them before asking for the next batch.

    ``images`` (N, 3, H, W) uint8, channels last in memory; ``confidence`` and ``depth_m``
    (N, rows, cols) float32.
    """

    images: Tensor
    confidence: Tensor
    depth_m: Tensor


@dataclass(frozen=True, slots=True)
class Examples:
    """Images with their grid labels.

    Parameters
    ----------
    pixels
        Arrays of (n_i, H, W, 3) uint8, RGB, such as zero-copy views of a mapped file.
    confidence
        (N, rows, cols) float32, N the sum of the n_i.
    depth_m
        (N, rows, cols) float32, metres.
    """

    pixels: Sequence[NDArray[np.uint8]]
    confidence: NDArray[np.float32]
    depth_m: NDArray[np.float32]

    def __post_init__(self) -> None:
        count = sum(len(chunk) for chunk in self.pixels)
        if not count == len(self.confidence) == len(self.depth_m):
            raise ValueError(
                f"{count} images with {len(self.confidence)} confidence "
                f"and {len(self.depth_m)} depth labels"
            )
        if len({chunk.shape[1:] for chunk in self.pixels}) > 1:
            raise ValueError("images of more than one size")

    def __len__(self) -> int:
        return len(self.confidence)

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """Height, width and channels of every image."""
        height, width, channels = self.pixels[0].shape[1:]
        return height, width, channels


def order(count: int, *, seed: int, epoch: int) -> NDArray[np.int64]:
    """The images in this epoch's order: a permutation keyed by seed and epoch alone."""
    return np.random.default_rng([seed, epoch]).permutation(count)


def batch_count(count: int, batch_size: int) -> int:
    """Batches in an epoch; the last may be short."""
    return -(-count // batch_size)


def shuffled(examples: Examples, batch_size: int, *, seed: int, epoch: int) -> Iterator[Batch]:
    """Batches of one epoch, in the order of ``order``.

    Yields
    ------
    Batch
        ``batch_size`` examples, in the last batch what is left.
    """
    indices = order(len(examples), seed=seed, epoch=epoch)
    ends = np.cumsum([len(chunk) for chunk in examples.pixels])
    chunk_of = np.searchsorted(ends, indices, side="right")
    row_of = indices - np.concatenate([[0], ends])[chunk_of]
    buffer = np.empty((min(batch_size, len(examples)), *examples.image_shape), np.uint8)
    images = torch.from_numpy(buffer).permute(0, 3, 1, 2)
    for start in range(0, len(indices), batch_size):
        chosen = indices[start : start + batch_size]
        for slot, at in enumerate(range(start, start + len(chosen))):
            buffer[slot] = examples.pixels[chunk_of[at]][row_of[at]]
        yield Batch(
            images[: len(chosen)],
            torch.from_numpy(examples.confidence[chosen]),
            torch.from_numpy(examples.depth_m[chosen]),
        )
