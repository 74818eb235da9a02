"""Batches of images: their order, shuffling, shares and masks."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from dmrl.learn.data import batches
from dmrl.learn.data.batches import (
    ROBOT_FIELDS,
    ExampleSet,
    collate,
    count_batches,
    epoch_indices,
    iter_batches,
    prefetch,
)


def build_numbered(*sizes: int) -> ExampleSet:
    """Return images, in arrays of these sizes, and robots whose values are the image number."""
    count = sum(sizes)
    images = np.arange(count, dtype=np.uint8)[:, None, None, None] + np.zeros((8, 16, 3), np.uint8)
    robots = np.repeat(np.arange(count, dtype=np.float32), 2 * len(ROBOT_FIELDS))
    robots = robots.reshape(count, 2, len(ROBOT_FIELDS))
    return ExampleSet(np.split(images, np.cumsum(sizes)[:-1]), robots)


def test_every_image_is_used_once_with_its_labels() -> None:
    seen: list[int] = []
    for images, robots, _ in iter_batches(build_numbered(5, 0, 7, 1), 4):
        numbers = images[:, 0, 0, 0].tolist()
        assert (images == images[:, :1, :1, :1]).all()
        assert robots[:, 1, 9].tolist() == numbers
        seen += numbers
    assert seen == list(range(13))


def test_batches_are_uint8_channels_last_and_the_last_is_short() -> None:
    batches = [(len(b.images), b.images.dtype) for b in iter_batches(build_numbered(10), 4)]
    assert batches == [(4, torch.uint8), (4, torch.uint8), (2, torch.uint8)]
    assert count_batches(10, 4) == 3
    first = collate(build_numbered(10), [3, 1]).images
    assert first.shape == (2, 3, 8, 16)
    assert first[:, 0, 0, 0].tolist() == [3, 1]
    assert first.is_contiguous(memory_format=torch.channels_last)


def test_selected_images_keep_their_robots() -> None:
    some = build_numbered(3, 4).select(np.array([False, True, False, False, True, True, False]))
    assert [int(some.get_image(k)[0, 0, 0]) for k in range(3)] == [1, 4, 5]
    assert some.robots[:, 0, 0].tolist() == [1, 4, 5]


def test_the_order_depends_only_on_seed_and_epoch() -> None:
    np.testing.assert_array_equal(
        epoch_indices(50, seed=1, epoch=2), epoch_indices(50, seed=1, epoch=2)
    )
    assert not np.array_equal(
        epoch_indices(50, seed=1, epoch=2), epoch_indices(50, seed=1, epoch=3)
    )
    assert not np.array_equal(
        epoch_indices(50, seed=1, epoch=2), epoch_indices(50, seed=2, epoch=2)
    )
    assert sorted(epoch_indices(50, seed=1, epoch=2)) == list(range(50))


def test_images_are_drawn_in_proportion_to_their_weights() -> None:
    shares = np.array([4.0] * 10 + [0.25] * 40)
    seen = np.zeros(50)
    for epoch in range(40):
        drawn = epoch_indices(50, seed=0, epoch=epoch, shares=shares)
        assert len(drawn) == 50
        np.add.at(seen, drawn, 1)
    np.testing.assert_allclose(seen[:10] / 40, 4.0, atol=0.03)
    np.testing.assert_allclose(seen[10:].mean() / 40, 0.25, atol=0.01)
    assert (seen[10:] > 0).all()


def test_prefetch_keeps_the_order_and_raises_the_error_of_the_source() -> None:
    def items() -> Iterator[int]:
        yield from range(5)
        raise ZeroDivisionError

    got = []
    with pytest.raises(ZeroDivisionError):
        for item in prefetch(items()):
            got.append(item)
    assert got == [0, 1, 2, 3, 4]


def test_robots_that_do_not_match_the_images_are_refused() -> None:
    good = build_numbered(4)
    with pytest.raises(ValueError, match="4 images with robots of 3"):
        ExampleSet(good.pixels, good.robots[:3])
    with pytest.raises(ValueError, match="more than one size"):
        ExampleSet(
            [np.zeros((1, 8, 8, 3), np.uint8), np.zeros((1, 8, 16, 3), np.uint8)],
            good.robots[:2],
        )
    assert len(ROBOT_FIELDS) == good.robots.shape[-1]


def test_a_robot_gets_the_mask_that_covers_its_centre() -> None:
    robots = np.full((2, 3, len(ROBOT_FIELDS)), np.nan, np.float32)
    robots[1, :, :2] = (2.5, 1.5), (7.0, 3.0), (-1.0, 1.0)
    masks = np.zeros((2, 4, 8), np.uint8)
    masks[1, 1, 2], masks[1, 3, 6], masks[1, 1, 7] = 1, 2, 3
    examples = ExampleSet([np.zeros((2, 4, 8, 3), np.uint8)], robots, [masks])
    mine = examples.get_mask(1, 0)
    assert mine is not None and np.argwhere(mine).tolist() == [[1, 2]]
    assert examples.get_mask(1, 1) is None  # No mask covers its centre.
    assert examples.get_mask(1, 2) is None  # Its centre is outside the image.
    assert examples.get_mask(0, 0) is None  # The image has no robot.
    assert ExampleSet(examples.pixels, robots).get_mask(1, 0) is None
    chosen = examples.select(np.array([False, True]))
    assert chosen.get_mask(0, 0) is not None
    with pytest.raises(ValueError, match="masks that do not fit"):
        ExampleSet(examples.pixels, robots, [masks[:, :3]])


def test_batch_count_is_rounded_up() -> None:
    assert [count_batches(count, 4) for count in (0, 1, 4, 5, 8)] == [0, 1, 1, 2, 2]
    assert build_numbered(5).image_shape == (8, 16, 3)
    assert len(build_numbered(5, 2)) == 7


@pytest.mark.parametrize("count", [40, 41, 47, 16])
def test_large_sets_are_shuffled_in_blocks_within_windows(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "SHUFFLE_WINDOW_IMAGES", 16)
    monkeypatch.setattr(batches, "SHUFFLE_BLOCK_IMAGES", 4)
    found = [epoch_indices(count, seed=3, epoch=epoch) for epoch in range(6)]
    assert all(sorted(one) == list(range(count)) for one in found)
    assert len({one.tobytes() for one in found}) == 6
    if count == 16:
        return  # One window shuffles the whole set.
    windows = [set((one[start : start + 16] // 4).tolist()) for one in found
               for start in range(0, count, 16)]  # fmt: skip
    # A window takes four blocks, or five where the short last block is among them.
    assert max(map(len, windows)) <= 5
    assert any(max(blocks) - min(blocks) > 4 for blocks in windows)
    assert any((np.diff(one[:16]) != 1).sum() > 12 for one in found)


def test_fractional_weights_round_to_whole_images() -> None:
    shares = np.array([0.5, 0.5, 2.0, 1.0])
    for epoch in range(20):
        drawn = np.bincount(epoch_indices(4, seed=0, epoch=epoch, shares=shares), minlength=4)
        assert drawn.sum() == 4 and drawn[2] == 2 and drawn[3] == 1 and drawn[:2].sum() == 1


def test_epoch_has_the_requested_number_of_images() -> None:
    """A small set repeats evenly; of a large set an epoch draws each image once at most.

    Over many epochs nearly every image of the large set is drawn.
    """
    often = np.bincount(epoch_indices(3, seed=0, epoch=0, images=10), minlength=3)
    assert often.sum() == 10 and set(often.tolist()) == {3, 4}
    shares = np.array([3.0, 1.0, 0.0])
    assert np.bincount(epoch_indices(3, seed=0, epoch=0, shares=shares, images=8)).tolist() == [
        6,
        2,
    ]
    some = [epoch_indices(1000, seed=0, epoch=epoch, images=100) for epoch in range(60)]
    assert all(len(one) == len(set(one.tolist())) == 100 for one in some)
    assert len(set(np.concatenate(some).tolist())) > 990
    assert sorted(epoch_indices(50, seed=1, epoch=2, images=50)) == list(range(50))


def test_a_mask_is_found_for_centres_up_to_the_edge_of_the_image() -> None:
    robots = np.full((1, 4, len(ROBOT_FIELDS)), np.nan, np.float32)
    robots[0, :, :2] = (0.0, 0.0), (7.9, 3.9), (3.0, 4.0), (8.0, 2.0)
    masks = np.zeros((1, 4, 8), np.uint8)
    masks[0, 0, 0], masks[0, 3, 7], masks[0, 3, 3], masks[0, 2, 7] = 1, 2, 3, 4
    examples = ExampleSet([np.zeros((1, 4, 8, 3), np.uint8)], robots, [masks])
    assert [examples.get_mask(0, k) is not None for k in range(4)] == [True, True, False, False]
