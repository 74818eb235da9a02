import numpy as np
import pytest
import torch

from dmrl.learn.batches import Examples, batch_count, order, shuffled


def numbered(*sizes: int) -> Examples:
    """Images and labels whose every value is the image's number."""
    count = sum(sizes)
    images = np.arange(count, dtype=np.uint8)[:, None, None, None] + np.zeros((8, 16, 3), np.uint8)
    grids = np.arange(count, dtype=np.float32)[:, None, None] + np.zeros((1, 2), np.float32)
    return Examples(np.split(images, np.cumsum(sizes)[:-1]), grids, grids + 0.5)


def test_every_image_comes_once_with_its_own_label() -> None:
    seen: list[int] = []
    for images, confidence, depth_m in shuffled(numbered(5, 0, 7, 1), 4, seed=0, epoch=0):
        numbers = images[:, 0, 0, 0].tolist()
        assert (images == images[:, :1, :1, :1]).all()
        assert confidence[:, 0, 0].tolist() == numbers
        assert depth_m[:, 0, 1].tolist() == [n + 0.5 for n in numbers]
        seen += numbers
    assert sorted(seen) == list(range(13))


def test_batches_are_uint8_views_channels_last_and_the_last_is_short() -> None:
    batches = [(len(b.images), b.images.dtype) for b in shuffled(numbered(10), 4, seed=0, epoch=0)]
    assert batches == [(4, torch.uint8), (4, torch.uint8), (2, torch.uint8)]
    assert batch_count(10, 4) == 3
    first = next(shuffled(numbered(10), 4, seed=0, epoch=0)).images
    assert first.shape == (4, 3, 8, 16)
    assert first.is_contiguous(memory_format=torch.channels_last)


def test_the_order_depends_on_seed_and_epoch_alone() -> None:
    np.testing.assert_array_equal(order(50, seed=1, epoch=2), order(50, seed=1, epoch=2))
    assert not np.array_equal(order(50, seed=1, epoch=2), order(50, seed=1, epoch=3))
    assert not np.array_equal(order(50, seed=1, epoch=2), order(50, seed=2, epoch=2))


def test_labels_that_do_not_match_the_images_are_refused() -> None:
    good = numbered(4)
    with pytest.raises(ValueError, match="4 images with 3 confidence and 4 depth labels"):
        Examples(good.pixels, good.confidence[:3], good.depth_m)
    with pytest.raises(ValueError, match="more than one size"):
        Examples(
            [np.zeros((1, 8, 8, 3), np.uint8), np.zeros((1, 8, 16, 3), np.uint8)],
            good.confidence[:2],
            good.depth_m[:2],
        )
