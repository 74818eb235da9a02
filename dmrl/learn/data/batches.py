"""Batches of training images: sampling by weights, shuffling, collation and prefetching.

The images of a dataset are a list of arrays, memory-mapped from its files. `collate` copies each
image once, as uint8. `prefetch` prepares the next batch in a thread during the training step.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Robots = NDArray[np.float32]
"""(..., 11): ``ROBOT_FIELDS`` of each robot; a row whose u is NaN is no robot."""

ROBOT_FIELDS = (
    *("u_px", "v_px", "depth_m", "sigma_u_px", "sigma_v_px", "sigma_depth_m"),
    *("left_px", "top_px", "right_px", "bottom_px"),
    "class_id",
)
U, V, DEPTH, SIGMA_U, SIGMA_V, SIGMA_DEPTH = range(6)
BOX, CLASS_ID = slice(6, 10), 10

SHUFFLE_BLOCK_IMAGES, SHUFFLE_WINDOW_IMAGES = 64, 8192
"""Images of a block, contiguous on disk as one Arrow batch; and images shuffled at a time, the
working set of reads: 1.8 GB at 320 x 224 pixels."""

T = TypeVar("T")


class Batch(NamedTuple):
    """Images and their robots.

    ``images`` (N, 3, H, W) uint8, channels last in memory; ``robots`` (N, K, 11) float32; ``poses``
    (N, 12) of the camera, where images have no labels and 2k and 2k + 1 are a pair.
    """

    images: Tensor
    robots: Tensor
    poses: Tensor | None = None


@dataclass(frozen=True)
class ExampleSet:
    """Images with their robots.

    Parameters
    ----------
    pixels
        (n_i, H, W, 3) uint8, RGB: views of a mapped file, or images that are decoded on use.
    robots
        (N, K, 11) float32, ``ROBOT_FIELDS`` of up to K robots in each of the N images, N the sum of
        the n_i. Sigmas are 0 where the label is exact; a box or class is NaN where there is none.
    masks
        Arrays of (n_i, H, W) uint8, segmentation masks: 0, or the index of a robot in ``robots``,
        from 1. Empty: no masks.
    require_whole
        Function that raises an error if the images can no longer be read.
    """

    pixels: Sequence[NDArray[np.uint8]]
    robots: Robots
    masks: Sequence[NDArray[np.uint8]] = ()
    require_whole: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        count = sum(len(chunk) for chunk in self.pixels)
        if count != len(self.robots):
            raise ValueError(f"{count} images with robots of {len(self.robots)}")
        if len({chunk.shape[1:] for chunk in self.pixels}) > 1:
            raise ValueError("images of more than one size")
        if self.masks and [m.shape for m in self.masks] != [p.shape[:3] for p in self.pixels]:
            raise ValueError("masks that do not fit the images")

    @cached_property
    def _ends(self) -> list[int]:
        return list(accumulate(len(chunk) for chunk in self.pixels))

    def __len__(self) -> int:
        return len(self.robots)

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """Height, width and channels of every image."""
        height, width, channels = self.pixels[0].shape[1:]
        return height, width, channels

    def select(self, chosen: NDArray[np.bool_]) -> "ExampleSet":
        """Return the chosen images, one chunk each, not copied."""
        numbers = np.flatnonzero(chosen)
        places = [self._locate_image(index) for index in numbers.tolist()]
        chunks = [self.pixels[chunk][place : place + 1] for chunk, place in places]
        masks = [self.masks[chunk][place][None] for chunk, place in places if self.masks]
        return ExampleSet(chunks, self.robots[numbers], masks, self.require_whole)

    def get_image(self, index: int) -> NDArray[np.uint8]:
        """Return the (H, W, 3) image at an index."""
        chunk, place = self._locate_image(index)
        found: NDArray[np.uint8] = self.pixels[chunk][place]
        return found

    def get_mask(self, index: int, robot: int) -> NDArray[np.uint8] | None:
        """Return (H, W) 1 where an image shows this robot; None if its centre is not visible."""
        if not self.masks:
            return None
        chunk, place = self._locate_image(index)
        mine: NDArray[np.uint8] = (self.masks[chunk][place] == robot + 1).view(np.uint8)
        u, v = self.robots[index, robot, [U, V]]
        seen = 0 <= u < mine.shape[1] and 0 <= v < mine.shape[0] and mine[int(v), int(u)]
        return mine if seen else None

    def _locate_image(self, index: int) -> tuple[int, int]:
        chunk = bisect_right(self._ends, index)
        return chunk, index - (self._ends[chunk - 1] if chunk else 0)


def epoch_indices(
    count: int, *, seed: int, epoch: int, shares: NDArray[np.float64] | None = None, images: int = 0
) -> NDArray[np.int64]:
    """Return the image indices of an epoch, determined by seed and epoch only.

    With more than ``SHUFFLE_WINDOW_IMAGES`` images, blocks are shuffled, and then the images of
    each window of blocks. Reads that are close in time are then close in the file, whatever its
    size.

    Parameters
    ----------
    count
        Number of images.
    seed, epoch
        Seed of the order.
    shares
        (count,) how often each image shall appear in an epoch, in proportion. The integer part is
        exact, the rest is random. None: equally often.
    images
        Images per epoch. 0: ``count``.
    """
    rng = np.random.default_rng([seed, epoch])
    images = images or count
    if shares is None and images == count:
        if count > SHUFFLE_WINDOW_IMAGES:
            return _shuffle_windows(count, rng)
        return rng.permutation(count)
    shares = np.ones(count) if shares is None else shares
    # Systematic sampling: every image appears floor or ceil of its share, and the sum is exact.
    ticks = np.floor(np.cumsum(shares[rng.permutation(count)]) * images / shares.sum() + 1e-9)
    ticks[-1] = images  # rounding of the sum may make it one less
    times = np.diff(ticks, prepend=0).astype(np.int64)
    rng = np.random.default_rng([seed, epoch])
    return rng.permutation(np.repeat(rng.permutation(count), times))


def _shuffle_windows(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    blocks = rng.permutation(-(-count // SHUFFLE_BLOCK_IMAGES))
    rows = (blocks[:, None] * SHUFFLE_BLOCK_IMAGES + np.arange(SHUFFLE_BLOCK_IMAGES)).ravel()
    rows = rows[rows < count]
    starts = range(0, count, SHUFFLE_WINDOW_IMAGES)
    return np.concatenate(
        [rng.permutation(rows[start : start + SHUFFLE_WINDOW_IMAGES]) for start in starts]
    )


def count_batches(count: int, batch_size: int) -> int:
    """Return the number of batches in an epoch; the last may be short."""
    return -(-count // batch_size)


def collate(examples: ExampleSet, chosen: Sequence[int] | NDArray[np.int64]) -> Batch:
    """Collate the chosen examples into a batch, without augmentation."""
    examples.require_whole()
    images = np.stack([examples.get_image(int(index)) for index in chosen])
    robots = torch.from_numpy(examples.robots[np.asarray(chosen)])
    return Batch(torch.from_numpy(images).permute(0, 3, 1, 2), robots)


def iter_batches(examples: ExampleSet, batch_size: int) -> Iterator[Batch]:
    """Yield batches of all examples in order."""
    for start in range(0, len(examples), batch_size):
        yield collate(examples, np.arange(start, min(start + batch_size, len(examples))))


def prefetch(items: Iterator[T]) -> Iterator[T]:
    """Yield the items, computing the next one in a thread meanwhile."""
    with ThreadPoolExecutor(1) as pool:
        ends = object()
        coming = pool.submit(next, items, ends)
        while (item := coming.result()) is not ends:
            coming = pool.submit(next, items, ends)
            yield item  # type: ignore[misc]
