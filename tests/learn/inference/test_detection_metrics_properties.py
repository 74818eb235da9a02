"""Metrics of random detections, compared with plain computations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.learn.inference.detection_metrics import (
    average_precision,
    compute_metrics,
    score_detections,
)
from dmrl.learn.inference.matching import Points


def draw_points(seed: int, images: int) -> tuple[Points, Points]:
    """Draw 2 labels and 3 detections an image on average, with distinct confidences.

    Some detections lie near labels.
    """
    rng = np.random.default_rng(seed)

    def some(most: int) -> Points:
        image = np.sort(rng.integers(0, images, most))
        u, v = rng.uniform(0, 60, (2, most))
        return Points(image, u, v, rng.uniform(0.2, 2.5, most), rng.permutation(most) / most)

    labels = some(2 * images)
    found = some(3 * images)
    order = np.lexsort((-found.confidence, found.image))
    return labels, found.select(order)


@pytest.mark.parametrize("seed", range(3))
def test_image_weights_equal_repetition_counts(seed: int) -> None:
    images, rng = 9, np.random.default_rng(seed)
    labels, found = draw_points(seed, images)
    scored = score_detections(images, labels, found)
    weights = rng.integers(0, 4, images)
    weights[0] = 2
    drawn = np.repeat(np.arange(images), weights)

    def again(points: Points) -> Points:
        parts = [points.select(points.image == k) for k in drawn]
        whole = Points.concatenate(parts, np.zeros(len(parts), np.int64))
        sizes = [len(part) for part in parts]
        return Points(np.repeat(np.arange(len(parts)), sizes), *(
            getattr(whole, n) for n in ("u_px", "v_px", "depth_m", "confidence")))  # fmt: skip

    repeated = score_detections(len(drawn), again(labels), again(found))
    for band in ((0.0, np.inf), (0.5, 1.5)):
        got = compute_metrics(scored, band, 0.4, weights[None].astype(float))
        wanted = compute_metrics(repeated, band, 0.4, np.ones((1, len(drawn))))
        assert {k: v.tolist() for k, v in got.items()} == {
            k: pytest.approx(v.tolist(), nan_ok=True) for k, v in wanted.items()
        }


@given(st.lists(st.tuples(st.integers(0, 6), st.sampled_from("rwn")), min_size=1, max_size=15),
       st.integers(1, 9))  # fmt: skip
@pytest.mark.heavy
def test_average_precision_equals_a_sum_over_thresholds(
    rows: list[tuple[int, str]], more: int
) -> None:
    confidence = np.array([c / 7 for c, _ in rows])
    right, wrong = (np.array([kind == k for _, kind in rows]) for k in "rw")
    total = right.sum() + more
    curve = []  # recall and precision at each confidence, highest first
    for least in sorted(set(confidence), reverse=True):
        taken = confidence >= least
        if (taken & (right | wrong)).any():
            true = (taken & right).sum()
            curve.append((true / total, true / (taken & (right | wrong)).sum()))
    area, before = 0.0, 0.0
    for k, (recall, _) in enumerate(curve):
        area += (recall - before) * max(precision for _, precision in curve[k:])
        before = recall
    weights = np.ones((1, len(rows)))
    got = average_precision(confidence, right, wrong, weights, np.array([float(total)]))
    assert got[0] == pytest.approx(area)


@pytest.mark.parametrize("seed", range(3))
def test_metrics_equal_plain_shares_and_means(seed: int) -> None:
    labels, found = draw_points(seed, 12)
    scored = score_detections(12, labels, found)
    band, threshold = (0.5, 1.5), 0.35
    got = compute_metrics(scored, band, threshold, np.ones((1, 12)))
    sure = found.confidence >= threshold
    mine = (labels.depth_m >= band[0]) & (labels.depth_m < band[1])
    taken = scored.right_16_px
    true = sum(bool(sure[k] and taken[k] >= 0 and mine[taken[k]]) for k in range(len(found)))
    false = sum(
        bool(sure[k] and taken[k] < 0 and band[0] <= found.depth_m[k] < band[1])
        for k in range(len(found))
    )
    assert got["precision"][0] == pytest.approx(true / (true + false))
    assert got["recall"][0] == pytest.approx(true / mine.sum())
    precision, recall = got["precision"][0], got["recall"][0]
    assert got["f1"][0] == pytest.approx(2 * precision * recall / (precision + recall))
    error = scored.label_error
    seen = np.isfinite(error.norm_px) & mine
    assert got["mean_px"][0] == pytest.approx(error.norm_px[seen].mean())
    assert got["depth_mae_m"][0] == pytest.approx(np.abs(error.depth_m[seen]).mean())
    assert got["depth_rmse_m"][0] == pytest.approx((error.depth_m[seen] ** 2).mean() ** 0.5)
    assert got["bias_u_px"][0] == pytest.approx(np.median(error.u_px[seen]))
    assert got["bias_v_px"][0] == pytest.approx(np.median(error.v_px[seen]))
    assert got["within_8_px"][0] == pytest.approx((error.norm_px[mine] <= 8).mean())
