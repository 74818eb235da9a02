"""Merged detections of several shifted and mirrored views of one image."""

from collections.abc import Sequence

import numpy as np
import pytest

from dmrl.learn.inference.decode_grids import DETECTION_COLUMNS, Detections
from dmrl.learn.inference.tta import TTA_VIEWS, TtaView, apply_view, merge_views, undo_view

STRIDE_PX = 8


def build_detections(*images: Sequence[tuple[float, ...]]) -> Detections:
    """Return detections from rows of u_px, v_px, depth_m and confidence of each image."""
    wide = max(map(len, images))
    table = np.zeros((len(images), wide, len(DETECTION_COLUMNS)))
    for rows, mine in zip(table, images, strict=True):
        for row, values in zip(rows, mine, strict=False):
            row[:4] = values
    u, v, depth, confidence, sigma, class_id = np.moveaxis(table, 2, 0)
    count = np.array([len(mine) for mine in images])
    return Detections(u, v, depth, confidence, sigma, class_id.astype(np.int64), count)


@pytest.mark.parametrize("view", TTA_VIEWS)
def test_undoing_a_view_gives_the_position_in_the_image(view: TtaView) -> None:
    images = np.zeros((1, 48, 64, 3), np.uint8)
    images[0, 20, 13] = 255
    row, col = np.argwhere(apply_view(images, view, STRIDE_PX)[0, :, :, 0])[0]
    back = undo_view(
        build_detections([(col + 0.5, row + 0.5, 1.0, 0.9)]), view, STRIDE_PX, (48, 64)
    )
    assert (back.u_px[0, 0], back.v_px[0, 0]) == (13.5, 20.5)


def test_views_differ_and_the_first_is_the_image_itself() -> None:
    images = np.random.default_rng(0).integers(0, 255, (1, 48, 64, 3), np.uint8)
    all_shown = [apply_view(images, view, STRIDE_PX) for view in TTA_VIEWS]
    assert (all_shown[0] == images).all()
    assert len({one.tobytes() for one in all_shown}) == len(TTA_VIEWS)


def test_merging_views_takes_the_median() -> None:
    views = [
        build_detections([(10 + off, 20 - off, 1 + off / 10, 0.8)]) for off in (-1.0, 0.0, 5.0)
    ]
    both = merge_views(views)
    assert both.count.tolist() == [1]
    assert [getattr(both, n)[0, 0] for n in DETECTION_COLUMNS[:4]] == pytest.approx(
        [10, 20, 1, 0.8]
    )


def test_merging_one_view_changes_nothing() -> None:
    alone = build_detections(
        [(10, 20, 1, 0.8), (19, 20, 1.5, 0.7), (60, 40, 2, 0.1)], [(30, 20, 1, 0.6)]
    )
    again = merge_views([alone])
    assert again.count.tolist() == [3, 1]
    for name in DETECTION_COLUMNS:
        assert (getattr(again, name) == getattr(alone, name)).all()


def test_detection_in_one_view_has_lower_confidence() -> None:
    ghost = (60.0, 40.0, 2.0, 0.9)
    both = merge_views(
        [build_detections([ghost, (10, 20, 1, 0.8)]), *[build_detections([(10, 20, 1, 0.8)])] * 2]
    )
    assert both.u_px[0].tolist() == [10, 60]
    assert both.confidence[0].tolist() == pytest.approx([0.8, 0.3])


def test_merging_views_keeps_two_robots_and_separate_images() -> None:
    near = [(10.0, 20.0, 1.0, 0.8), (30.0, 20.0, 1.5, 0.7)]
    both = merge_views([build_detections(near, near[:1]), build_detections(near[::-1], near[1:])])
    assert both.count.tolist() == [2, 2]
    assert both.u_px.tolist() == [[10, 30], [10, 30]]
    assert both.confidence[1].tolist() == pytest.approx([0.4, 0.35])


def test_the_best_detections_are_kept_and_always_one() -> None:
    views = [build_detections([(10, 20, 1, 0.005), (50, 20, 1, 0.004)])] * 2
    assert merge_views(views).count.tolist() == [1]
    sure = [build_detections([(10, 20, 1, 0.5), (50, 20, 1, 0.4)])] * 2
    assert merge_views(sure, most=1).u_px.tolist() == [[10]]


def test_views_cover_the_cell_evenly() -> None:
    halves = {(v.right, v.down) for v in TTA_VIEWS if v.right >= 0 and v.down >= 0}
    assert halves == {(right, down) for right in (0, 0.5) for down in (0, 0.5)}
    quarters = [(v.right, v.down) for v in TTA_VIEWS if (v.right, v.down) not in halves]
    assert np.sum(quarters, axis=0).tolist() == [0, 0]  # Their shifts cancel.
    assert {abs(part) for both in quarters for part in both} == {0.25}


@pytest.mark.parametrize(("apart", "count"), [(15.9, 1), (16.0, 1), (16.1, 2)])
def test_detections_16_px_apart_are_of_one_robot(apart: float, count: int) -> None:
    both = merge_views(
        [build_detections([(10, 20, 1, 0.8)]), build_detections([(10, 20 + apart, 1, 0.6)])]
    )
    assert both.count.tolist() == [count]
    assert both.confidence[0].tolist() == pytest.approx([0.7] if count == 1 else [0.4, 0.3])


def test_merging_views_pairs_the_nearer_of_two_detections() -> None:
    both = merge_views(
        [
            build_detections([(10, 20, 1, 0.8)]),
            build_detections([(14, 20, 3, 0.7), (12, 20, 2, 0.6)]),
        ]
    )
    assert both.u_px[0].tolist() == pytest.approx([11, 14])
    assert both.depth_m[0].tolist() == pytest.approx([1.5, 3])
    assert both.confidence[0].tolist() == pytest.approx([0.7, 0.35])


@pytest.mark.parametrize(("confidence", "count"), [(0.01, 2), (0.009, 1)])
def test_a_detection_at_the_minimum_confidence_is_kept(confidence: float, count: int) -> None:
    assert merge_views(
        [build_detections([(10, 20, 1, 0.5), (50, 20, 1, confidence)])]
    ).count.tolist() == [count]


def test_merged_class_is_of_the_surest_view_and_sigma_the_median() -> None:
    views = [build_detections([(10, 20, 1, confidence)]) for confidence in (0.5, 0.9, 0.7)]
    for k, view in enumerate(views):
        view.class_id[:], view.sigma_depth_m[:] = k, (0.1, 0.4, 0.2)[k]
    both = merge_views(views)
    assert (both.class_id[0, 0], both.sigma_depth_m[0, 0]) == (1, 0.2)


@pytest.mark.parametrize("view", TTA_VIEWS)
def test_detections_outside_the_image_are_clipped_to_its_edge(view: TtaView) -> None:
    corners = build_detections([(-50.0, -50.0, 1, 0.9), (150.0, 150.0, 1, 0.8)])
    back = undo_view(corners, view, STRIDE_PX, (48, 64))
    assert sorted(back.u_px[0].tolist()) == [0, 64]
    assert back.v_px[0].tolist() == [0, 48]
