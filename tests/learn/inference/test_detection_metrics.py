"""Metrics of detections, compared with cases computed by hand."""

import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.learn.inference.detection_metrics import (
    DEPTH_BANDS_M,
    BandMetrics,
    average_precision,
    compute_band_metrics,
    compute_curves,
    compute_metrics,
    compute_weighted_quantile,
    iter_bootstrap_weights,
    score_detections,
)
from dmrl.learn.inference.matching import Points
from dmrl.learn.inference.metric_definitions import METRIC_DEFINITIONS


def build_scene(images: int, offset_px: float = 0.0, depth_m: float = 1.0) -> tuple[Points, Points]:
    """Return one label an image and its detection, offset to the left and 0.1 m too near."""
    image = np.arange(images)
    u, v, d = np.full(images, 100.0), np.full(images, 50.0), np.full(images, depth_m)
    ones = np.ones(images)
    return Points(image, u, v, d, ones), Points(image, u - offset_px, v, d - 0.1, 0.9 * ones)


def compute_overall(labels: Points, found: Points, images: int, draws: int = 20) -> BandMetrics:
    """Return the metrics over all depths at threshold 0.33."""
    return compute_band_metrics(
        score_detections(images, labels, found), threshold=0.33, draws=draws
    )[0]


def get_values(band: BandMetrics) -> dict[str, float]:
    """Return the value of each metric by name, without its interval."""
    return {name: figure.value for name, figure in band.figures.items()}


def test_a_perfect_detector_has_perfect_metrics() -> None:
    labels, found = build_scene(10)
    got = get_values(compute_overall(labels, found, 10))
    assert got["median_px"] == got["p95_px"] == got["rmse_px"] == got["bias_u_px"] == 0
    assert got["within_8_px"] == got["f1"] == got["ap_8_px"] == got["ap_16_px"] == 1
    assert got["depth_mae_m"] == pytest.approx(0.1)


def test_curves_of_four_detections_equal_hand_computed_ones() -> None:
    labels, _ = build_scene(3)
    at = np.full(4, 100.0)
    at[2] = 200.0  # The third is far from every label.
    confidence = np.array([0.95, 0.85, 0.85, 0.15])
    depth = np.ones(4)
    found = Points(np.array([0, 1, 1, 2]), at, np.full(4, 50.0), depth, confidence)
    got = compute_curves(score_detections(3, labels, found))
    # Detections of equal confidence are one point of the curve.
    assert got.confidence.tolist() == [0.95, 0.85, 0.15]
    assert got.precision == pytest.approx([1, 2 / 3, 3 / 4])
    assert got.recall == pytest.approx([1 / 3, 2 / 3, 1])
    assert got.bin_count.tolist() == [0, 1, 0, 0, 0, 0, 0, 0, 2, 1]
    assert got.bin_right[[1, 8, 9]].tolist() == [1, 0.5, 1]
    assert got.bin_confidence[[1, 8, 9]] == pytest.approx([0.15, 0.85, 0.95])
    assert np.isnan(got.bin_right[0])


def test_curves_without_detections_or_labels_are_empty() -> None:
    labels, found = build_scene(3)
    none = found.select(found.image > 9)
    assert compute_curves(score_detections(3, labels, none)).recall.size == 0
    assert np.isnan(compute_curves(score_detections(3, none, found)).recall).all()
    many = compute_curves(score_detections(3, *build_scene(3)), most=1)
    assert many.recall.tolist() == [1.0]


def test_metrics_of_a_known_offset_equal_it() -> None:
    labels, found = build_scene(10, offset_px=12)
    got = get_values(compute_overall(labels, found, 10))
    assert got["median_px"] == got["mean_px"] == got["rmse_px"] == -got["bias_u_px"] == 12
    assert (got["within_8_px"], got["within_20_px"]) == (0, 1)
    assert (got["ap_8_px"], got["ap_16_px"], got["recall"]) == (0, 1, 1)


def test_missed_labels_lower_recall_and_not_precision() -> None:
    labels, found = build_scene(10)
    half = found.select(found.image < 5)
    band = compute_overall(labels, half, 10)
    got = get_values(band)
    assert band.unmatched == 5
    assert got["within_20_px"] == got["recall"] == got["ap_16_px"] == 0.5
    assert got["precision"] == 1
    assert got["f1"] == pytest.approx(2 / 3)
    assert got["rmse_px"] == 0
    assert got["median_px"] == math.inf


def test_detections_in_images_without_labels_are_wrong() -> None:
    labels, found = build_scene(10)
    got = get_values(compute_overall(labels.select(labels.image < 5), found, 10))
    assert (got["precision"], got["recall"], got["within_8_px"]) == (0.5, 1, 1)


def test_detections_below_the_threshold_do_not_count_in_precision_and_recall() -> None:
    labels, found = build_scene(4)
    sure = Points(found.image, found.u_px, found.v_px, found.depth_m, np.array([0.9, 0.33, 0.3, 0]))
    got = get_values(compute_overall(labels, sure, 4))
    assert (got["precision"], got["recall"]) == (1, 0.5)
    assert got["ap_16_px"] == 1


def test_bands_hold_their_own_labels_and_empty_bands_are_nan() -> None:
    labels, found = build_scene(10, depth_m=0.7)
    bands = compute_band_metrics(score_detections(10, labels, found), threshold=0.33, draws=5)
    assert [(b.from_m, b.to_m) for b in bands] == list(DEPTH_BANDS_M)
    assert [b.labels for b in bands] == [10, 0, 10, 0, 0, 0]
    assert all(math.isnan(figure.value) for figure in bands[-1].figures.values())
    assert set(bands[0].figures) == set(METRIC_DEFINITIONS) - {"error", "band", "interval"}


def test_a_wrong_detection_counts_in_the_band_of_its_own_depth() -> None:
    labels, found = build_scene(10, depth_m=0.7)
    extra = Points(np.arange(10), np.zeros(10), np.zeros(10), np.full(10, 1.7), np.full(10, 0.8))
    order = np.argsort(np.concatenate([found.image, extra.image]), kind="stable")
    both = Points.concatenate([found, extra], np.zeros(2, np.int64)).select(order)
    bands = compute_band_metrics(score_detections(10, labels, both), threshold=0.33, draws=5)
    assert [b.figures["precision"].value for b in bands[:3:2]] == [0.5, 1]
    assert bands[4].figures["precision"].value == 0


def test_average_precision_of_a_ranked_list_equals_a_hand_computed_one() -> None:
    right = np.array([True, False, True, False])
    area = average_precision(
        np.array([0.9, 0.8, 0.7, 0.6]), right, ~right, np.ones((1, 4)), np.array([4.0])
    )
    # Recall is 1/4 at precision 1, then 2/4 at 2/3; two of four labels are never found.
    assert area[0] == pytest.approx(1 / 4 + 1 / 4 * 2 / 3)


def test_equal_confidences_count_together_in_any_order() -> None:
    confidence = np.array([0.9, 0.5, 0.5, 0.5])
    for right in ([True, True, False, False], [True, False, False, True]):
        is_right = np.array(right)
        area = average_precision(confidence, is_right, ~is_right, np.ones((1, 4)), np.array([2.0]))
        # The threshold that finds the second label admits all four detections.
        assert area[0] == pytest.approx(1 / 2 + 1 / 2 * 2 / 4)


@pytest.mark.heavy
def test_intervals_cover_the_value_and_shrink_with_more_images() -> None:
    rng = np.random.default_rng(0)
    widths = []
    for images in (30, 3000):
        labels, found = build_scene(images)
        near = rng.random(images) < 0.7
        off = Points(
            found.image, np.where(near, found.u_px, 0), found.v_px, found.depth_m, found.confidence
        )
        share = compute_overall(labels, off, images, draws=300).figures["within_8_px"]
        assert share.low < share.value < share.high
        widths.append(share.high - share.low)
    assert widths[1] == pytest.approx(2 * 1.96 * math.sqrt(0.7 * 0.3 / 3000), rel=0.2)
    assert widths[0] > 5 * widths[1]


def test_the_seed_decides_the_intervals() -> None:
    rng = np.random.default_rng(1)
    labels, found = build_scene(40)
    off = Points(found.image, rng.random(40) * 200, found.v_px, found.depth_m, found.confidence)
    scored = score_detections(40, labels, off)

    def figures(seed: int) -> list[BandMetrics]:
        return compute_band_metrics(scored, threshold=0.33, draws=50, seed=seed)[:1]

    # Representations are compared because NaN does not equal NaN.
    assert repr(figures(1)) == repr(figures(1)) != repr(figures(2))


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=30), st.randoms())
@pytest.mark.heavy
def test_weighted_median_equals_that_of_repeated_numbers(
    numbers: list[float], random: object
) -> None:
    array = np.array(numbers)
    times = np.array([random.randint(1, 3) for _ in numbers])  # type: ignore[attr-defined]
    repeated = np.repeat(array, times)
    got = compute_weighted_quantile(array, times[None].astype(float), 0.5)
    assert got[0] == pytest.approx(np.median(repeated))


@pytest.mark.slow
def test_ten_thousand_images_take_seconds() -> None:
    rng = np.random.default_rng(0)
    images = 10_000
    labels, found = build_scene(images)
    off = Points(
        found.image,
        rng.random(images) * 200,
        found.v_px,
        rng.random(images) * 2.5,
        found.confidence,
    )
    begun = time.process_time()
    compute_band_metrics(score_detections(images, labels, off), threshold=0.33)
    assert time.process_time() - begun < 20


@pytest.mark.heavy
def test_an_interval_holds_the_middle_95_percent() -> None:
    images = 400
    labels, found = build_scene(images)
    half = Points(
        found.image,
        found.u_px - 30 * (found.image % 2),
        found.v_px,
        found.depth_m,
        found.confidence,
    )
    band = compute_band_metrics(score_detections(images, labels, half), threshold=0.33, draws=2000)[
        0
    ]
    share = band.figures["within_8_px"]
    reach = 1.96 * math.sqrt(0.25 / images)  # the interval of a share of one half
    assert share.value == 0.5
    assert (share.low, share.high) == pytest.approx((0.5 - reach, 0.5 + reach), abs=0.006)


def compute_metrics_of_errors(*errors: tuple[float, float, float]) -> dict[str, float]:
    """Return metrics of one label an image, by errors of its detection.

    Errors are in pixels to the right and down, and in metres behind the label.
    """
    off = np.array(errors)
    image, u = np.arange(len(off)), np.full(len(off), 100.0)
    truth = Points(image, u, u / 2, u / 50, np.ones(len(off)))
    found = Points(image, u + off[:, 0], u / 2 + off[:, 1], u / 50 + off[:, 2], np.ones(len(off)))
    weights = np.ones((1, len(off)))
    got = compute_metrics(score_detections(len(off), truth, found), (0.0, np.inf), 0.5, weights)
    return {name: float(value[0]) for name, value in got.items()}


def test_metrics_of_different_errors_equal_hand_computed_values() -> None:
    got = compute_metrics_of_errors(
        (3.0, 4.0, 0.1), (0.0, 12.0, -0.2), (-8.0, 0.0, 0.4), (30.0, 40.0, 0.0)
    )
    assert got["mean_px"] == pytest.approx((5 + 12 + 8 + 50) / 4)
    assert got["rmse_px"] == pytest.approx(((25 + 144 + 64 + 2500) / 4) ** 0.5)
    assert got["median_px"] == pytest.approx(10)
    assert got["p95_px"] == pytest.approx(50)
    # The bias is the median of detection minus label: of 3, 0, -8 and 30 px.
    assert got["bias_u_px"] == pytest.approx(1.5)
    assert got["bias_v_px"] == pytest.approx(8)
    assert got["depth_mae_m"] == pytest.approx(0.7 / 4)
    assert got["depth_rmse_m"] == pytest.approx((0.21 / 4) ** 0.5)
    assert (got["within_8_px"], got["within_20_px"]) == (0.5, 0.75)
    assert (got["ap_8_px"], got["ap_16_px"]) == pytest.approx((0.5 * 0.5, 0.75 * 0.75))


@pytest.mark.parametrize(("off_px", "name"), [(8.0, "within_8_px"), (20.0, "within_20_px")])
def test_an_error_equal_to_the_radius_is_within_it(off_px: float, name: str) -> None:
    assert [compute_metrics_of_errors((off, 0, 0))[name] for off in (off_px, off_px + 0.1)] == [
        1,
        0,
    ]


def test_a_band_includes_its_lower_end() -> None:
    for depth_m, held in ((0.5, 2), (0.499, 1), (1.0, 3), (1.5, 4), (2.0, 5)):
        bands = compute_band_metrics(
            score_detections(1, *build_scene(1, depth_m=depth_m)), threshold=0.33, draws=2
        )
        assert [band.labels for band in bands] == [1, *(int(k == held) for k in range(1, 6))]
        assert bands[held].images == 1


def test_bootstrap_samples_have_the_number_of_images() -> None:
    labels, found = build_scene(7)
    rows = np.concatenate(list(iter_bootstrap_weights(score_detections(7, labels, found), 500, 3)))
    assert rows.shape == (500, 7)
    assert (rows.sum(axis=1) == 7).all()
    assert rows.mean(axis=0) == pytest.approx(np.ones(7), abs=0.15)
    # The count of an image is binomial: 7 draws with probability 1 / 7.
    assert rows.var() == pytest.approx(6 / 7, rel=0.1)


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 3)), min_size=1, max_size=12))
def test_weighted_quantile_equals_quantile_of_repeated_values(pairs: list[tuple[int, int]]) -> None:
    values_, counts = (np.array(x, float) for x in zip(*pairs, strict=True))
    repeated = np.repeat(values_, counts.astype(int))
    for share in (0.25, 0.5, 0.95):
        (got,) = compute_weighted_quantile(values_, counts[None], share)
        if len(repeated):
            wanted = np.quantile(repeated, share, method="averaged_inverted_cdf")
            assert got == pytest.approx(wanted)
        else:
            assert math.isnan(got)


def test_curves_are_thinned_evenly_and_confidence_1_is_in_the_last_bin() -> None:
    labels, _ = build_scene(100)
    confidence = np.linspace(1.0, 0.01, 100)
    found = Points(labels.image, labels.u_px, labels.v_px, labels.depth_m, confidence)
    got = compute_curves(score_detections(100, labels, found), most=5)
    assert got.confidence == pytest.approx([1.0, 0.75, 0.5, 0.26, 0.01], abs=0.011)
    assert got.recall == pytest.approx([0.01, 0.26, 0.51, 0.75, 1.0], abs=0.011)
    assert got.bin_count[9] == 11 and got.bin_count.sum() == 100
