"""Detections matched with labels, compared with exhaustive search."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dmrl.learn.inference.matching import (
    Points,
    assign_detections,
    compute_errors,
    match_within_radius,
)


def build_points(*rows: tuple[int, float, float, float, float]) -> Points:
    """Return points from rows of image, u, v, depth and confidence."""
    columns = np.array(rows, float).reshape(-1, 5).T
    return Points(columns[0].astype(np.int64), *columns[1:])


PIXELS = st.integers(0, 9).map(float)


@given(arrays(float, st.tuples(st.integers(1, 4), st.just(2)), elements=PIXELS),
       arrays(float, st.tuples(st.integers(1, 4), st.just(2)), elements=PIXELS))  # fmt: skip
@pytest.mark.heavy
def test_labels_and_detections_pair_at_the_least_total_distance(
    label_px: np.ndarray, found_px: np.ndarray
) -> None:
    labels = build_points(*[(0, u, v, 1, 1) for u, v in label_px])
    found = build_points(*[(0, u, v, 1, 1) for u, v in found_px])
    got = assign_detections(labels, found)
    # Only the most confident detections take part, as many as there are labels.
    cost = np.hypot(*(label_px[:, None] - found_px[None, : len(label_px)]).transpose(2, 0, 1))
    paired = np.flatnonzero(got >= 0)
    assert len(set(got[paired])) == len(paired) == min(cost.shape)
    table = cost if cost.shape[0] <= cost.shape[1] else cost.T
    least = min(
        sum(table[i, j] for i, j in enumerate(p))
        for p in permutations(range(table.shape[1]), table.shape[0])
    )
    assert cost[paired, got[paired]].sum() == pytest.approx(least)


def test_one_label_takes_the_most_confident_detection_not_the_nearest() -> None:
    labels = build_points((0, 10, 10, 1, 1))
    found = build_points((0, 100, 10, 2, 0.9), (0, 11, 10, 1, 0.8))
    assert assign_detections(labels, found).tolist() == [0]
    assert compute_errors(labels, found).u_px.tolist() == [90.0]
    assert compute_errors(labels, found).depth_m.tolist() == [1.0]


def test_two_labels_are_assigned_at_least_total_distance() -> None:
    labels = build_points((3, 0, 0, 1, 1), (3, 10, 0, 1, 1))
    # A greedy assignment would give u = 9 to the first label and leave 30 px to the second.
    # The third detection is on the first label, but only the two most confident take part.
    found = build_points((3, 9, 0, 1, 0.9), (3, -20, 0, 1, 0.8), (3, 0, 0, 1, 0.7))
    assert assign_detections(labels, found).tolist() == [1, 0]


def test_a_label_without_a_detection_has_an_infinite_error() -> None:
    labels = build_points((0, 0, 0, 1, 1), (1, 0, 0, 1, 1), (1, 50, 0, 1, 1))
    found = build_points((1, 49, 0, 1, 0.9))
    assert assign_detections(labels, found).tolist() == [-1, -1, 0]
    assert compute_errors(labels, found).norm_px.tolist() == [np.inf, np.inf, 1.0]
    assert np.isnan(compute_errors(labels, build_points()).depth_m).all()


def test_each_label_matches_once_in_order_of_confidence() -> None:
    labels = build_points((0, 10, 10, 1, 1), (0, 20, 10, 1, 1))
    found = build_points(
        (0, 12, 10, 1, 0.9), (0, 11, 10, 1, 0.8), (0, 200, 10, 1, 0.7), (1, 10, 10, 1, 0.9)
    )
    assert match_within_radius(labels, found, 16).tolist() == [0, 1, -1, -1]
    assert match_within_radius(labels, found, 8).tolist() == [0, -1, -1, -1]
    assert match_within_radius(build_points(), found, 16).tolist() == [-1] * 4
    assert match_within_radius(labels, build_points(), 16).tolist() == []


def test_a_detection_at_the_radius_matches() -> None:
    assert match_within_radius(
        build_points((0, 0, 0, 1, 1)), build_points((0, 0, 16, 1, 1)), 16
    ).tolist() == [0]


@pytest.mark.parametrize("seed", range(3))
def test_detections_match_within_their_image_only(seed: int) -> None:
    rng = np.random.default_rng(seed)

    def some(image: int) -> tuple[Points, Points]:
        def rows(count: int) -> list[tuple[int, float, float, float, float]]:
            return [(image, *(rng.random(2) * 50), 1.0, 1.0) for _ in range(count)]

        return build_points(*rows(rng.integers(0, 4))), build_points(*rows(rng.integers(0, 5)))

    parts = [some(0) for _ in range(6)]
    first = np.arange(6)
    labels = Points.concatenate([a for a, _ in parts], first)
    found = Points.concatenate([b for _, b in parts], first)
    together = compute_errors(labels, found).norm_px
    alone = np.concatenate([compute_errors(a, b).norm_px for a, b in parts])
    np.testing.assert_array_equal(together, alone)
    together_hits = (match_within_radius(labels, found, 16) >= 0).tolist()
    assert together_hits == [h >= 0 for a, b in parts for h in match_within_radius(a, b, 16)]


ROWS = st.lists(st.tuples(st.integers(0, 3), PIXELS, PIXELS), max_size=9).map(
    lambda rows: sorted(rows, key=lambda row: row[0])
)


@given(ROWS, ROWS, st.sampled_from([0.0, 1.0, 3.0, 5.0]))
@pytest.mark.heavy
def test_detections_match_greedily_to_the_nearest_free_label(
    label_rows: list[tuple[int, float, float]],
    found_rows: list[tuple[int, float, float]],
    radius_px: float,
) -> None:
    labels = build_points(*[(*row, 1, 1) for row in label_rows])
    found = build_points(*[(*row, 1, 1) for row in found_rows])
    free, wanted = set(range(len(label_rows))), []
    # Rows of equal confidence are matched in their order.
    for image, u, v in found_rows:
        near = [
            (np.hypot(label_rows[k][1] - u, label_rows[k][2] - v), k)
            for k in free
            if label_rows[k][0] == image
        ]
        distance, k = min(near, default=(np.inf, -1))
        wanted.append(k if distance <= radius_px else -1)
        free.discard(wanted[-1])
    assert match_within_radius(labels, found, radius_px).tolist() == wanted
