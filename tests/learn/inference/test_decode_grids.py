"""Detections decoded from the grids of a network."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dmrl.learn.inference.decode_grids import decode, find_peaks


def test_peaks_come_best_first_at_the_cell_centre() -> None:
    confidence = np.zeros((1, 4, 6), np.float32)
    confidence[0, 1, 2], confidence[0, 1, 3], confidence[0, 3, 5] = 0.6, 0.5, 0.9
    depth_m = np.arange(24, dtype=np.float32).reshape(1, 4, 6)
    found = decode(confidence, depth_m)
    assert found.count.tolist() == [2]
    assert found.u_px[0, :2].tolist() == [44.0, 20.0]
    assert found.v_px[0, :2].tolist() == [28.0, 12.0]
    assert found.depth_m[0, :2].tolist() == [23.0, 8.0]
    np.testing.assert_allclose(found.confidence[0, :2], [0.9, 0.6])


def test_an_offset_moves_a_peak_and_keeps_it_in_the_image() -> None:
    confidence, offset = np.zeros((1, 4, 6)), np.zeros((1, 2, 4, 6))
    confidence[0, 1, 2], confidence[0, 3, 5] = 0.6, 0.9
    offset[0, :, 1, 2] = 0.25, -0.5
    offset[0, :, 3, 5] = 0.75, 0.0
    found = decode(confidence, np.ones((1, 4, 6)), offset)
    assert found.u_px[0, :2].tolist() == [48.0, 22.0]
    assert found.v_px[0, :2].tolist() == [28.0, 8.0]


def test_two_cells_that_point_to_one_robot_give_one_detection() -> None:
    confidence, offset = np.zeros((2, 4, 9)), np.zeros((2, 2, 4, 9))
    confidence[0, 1, [1, 3, 7]] = 0.9, 0.8, 0.7
    offset[0, 0, 1, 3] = -1.9
    confidence[1, 2, 4] = 0.5
    found = decode(confidence, np.arange(72.0).reshape(2, 4, 9), offset)
    assert found.count.tolist() == [2, 1]
    assert found.u_px[0, :2].tolist() == [12.0, 60.0]
    assert found.confidence[0, :2].tolist() == [0.9, 0.7]
    assert found.depth_m[0, :2].tolist() == [10.0, 16.0]
    assert found.u_px[1, 0] == 36.0


def test_the_best_cell_is_kept_at_any_confidence() -> None:
    confidence = np.full((2, 3, 3), 1e-6)
    confidence[0, 2, 2] = 2e-6
    found = decode(confidence, np.ones((2, 3, 3)), min_confidence=0.5)
    assert found.count.tolist() == [1, 1]
    assert (found.u_px[:, 0].tolist(), found.v_px[:, 0].tolist()) == ([20.0, 4.0], [20.0, 4.0])


def test_number_of_detections_is_limited() -> None:
    confidence = np.zeros((1, 9, 9))
    confidence[0, ::2, ::2] = np.arange(1, 26).reshape(5, 5) / 30
    found = decode(confidence, np.ones((1, 9, 9)), most=3)
    assert found.count.tolist() == [3]
    np.testing.assert_allclose(found.confidence[0], [25 / 30, 24 / 30, 23 / 30])


@given(arrays(np.float32, (1, 5, 6), elements=st.sampled_from([0.0, 0.25, 0.5])))
def test_plateau_gives_one_peak_and_first_maximum_is_a_peak(
    confidence: np.ndarray,
) -> None:
    found = find_peaks(confidence)[0]
    assert found.flat[confidence.argmax()]
    rows, cols = np.nonzero(found)
    for a in range(len(rows)):
        for b in range(a):
            assert max(abs(rows[a] - rows[b]), abs(cols[a] - cols[b])) > 1


def test_depth_sigma_and_class_are_taken_at_the_peak() -> None:
    confidence, offset = np.zeros((1, 4, 9)), np.zeros((1, 2, 4, 9))
    confidence[0, 1, [1, 7]] = 0.7, 0.9
    spread, class_id = np.full((1, 4, 9), 0.1), np.zeros((1, 4, 9), np.int64)
    spread[0, 1, 1], class_id[0, 1, 7] = 0.2, 1
    found = decode(confidence, np.full((1, 4, 9), 2.0), offset, spread, class_id)
    assert found.class_id[0, :2].tolist() == [1, 0]
    np.testing.assert_allclose(found.sigma_depth_m[0, :2], np.sqrt(2) * np.array([0.2, 0.4]))
    silent = decode(confidence, np.full((1, 4, 9), 2.0), offset)
    assert not silent.sigma_depth_m.any()
    assert not silent.class_id.any()


@pytest.mark.parametrize(("away_px", "count"), [(7.99, 1), (8.0, 2)])
def test_detections_within_one_cell_are_merged(away_px: float, count: int) -> None:
    confidence, offset = np.zeros((1, 4, 9)), np.zeros((1, 2, 4, 9))
    confidence[0, 1, [1, 3]] = 0.9, 0.8
    offset[0, 0, 1, 3] = away_px / 8 - 2
    assert decode(confidence, np.ones((1, 4, 9)), offset).count.tolist() == [count]


@pytest.mark.parametrize(("least", "count"), [(0.3, 2), (0.31, 1), (0.0, 3), (-1.0, 3)])
def test_peaks_below_the_minimum_confidence_are_dropped(least: float, count: int) -> None:
    confidence = np.full((1, 1, 9), 0.01)
    confidence[0, 0, [0, 4]] = 0.5, 0.3
    confidence[0, 0, 6:] = 0.0, 0.2, 0.0
    confidence[0, 0, 7] = 0.2 if least <= 0 else 0.0
    confidence[0, 0, [1, 2, 3, 5]] = 0.0
    found = decode(confidence, np.ones((1, 1, 9)), min_confidence=least)
    assert found.count[0] == count


def decode_in_loop(
    confidence: np.ndarray, offset: np.ndarray | None, most: int, least: float
) -> list[tuple[int, int, float, float]]:
    """Decode one grid in a loop; return (row, column, u, v) of detections, best first.

    Confidence (rows, columns) and offset (2, rows, columns) are in cells; u and v are in pixels.
    """
    rows, cols = confidence.shape
    found = []
    for r in range(rows):
        for c in range(cols):
            near = [
                (y, x)
                for y in range(max(r - 1, 0), min(r + 2, rows))
                for x in range(max(c - 1, 0), min(c + 2, cols))
                if (y, x) != (r, c)
            ]
            before = [confidence[at] for at in near if at < (r, c)]
            after = [confidence[at] for at in near if at > (r, c)]
            if all(confidence[r, c] > v for v in before) and all(
                confidence[r, c] >= v for v in after
            ):
                found.append((-float(confidence[r, c]), r, c))
    kept: list[tuple[int, int, float, float]] = []
    for k, (score, r, c) in enumerate(sorted(found)[:most]):
        if k and -score < max(least, 0.0):
            break
        u, v = c + 0.5, r + 0.5
        if offset is not None:
            u = min(max(u + offset[0, r, c], 0), cols)
            v = min(max(v + offset[1, r, c], 0), rows)
            if any(np.hypot(8 * u - a, 8 * v - b) < 8 for _, _, a, b in kept):
                continue
        kept.append((r, c, 8 * u, 8 * v))
    return kept


GRID = st.sampled_from([0.0, 0.005, 0.01, 0.25, 0.5, 0.75])


@given(
    arrays(float, (2, 4, 5), elements=GRID),
    arrays(float, (2, 2, 4, 5), elements=st.sampled_from([-1.5, -0.25, 0.0, 0.5, 2.0])),
    st.booleans(),
    st.integers(1, 6),
    st.sampled_from([-1.0, 0.01, 0.3]),
)
@pytest.mark.heavy
def test_decoded_detections_equal_a_loop_over_cells(
    confidence: np.ndarray, offset: np.ndarray, shifted: bool, most: int, least: float
) -> None:
    depth_m, spread = np.arange(1.0, 41).reshape(2, 4, 5), np.arange(40.0).reshape(2, 4, 5) / 40
    class_id = np.arange(40).reshape(2, 4, 5) % 7
    moved = offset if shifted else None
    found = decode(confidence, depth_m, moved, spread, class_id, most=most, min_confidence=least)
    for k in range(2):
        wanted = decode_in_loop(confidence[k], offset[k] if shifted else None, most, least)
        assert found.count[k] == len(wanted)
        for n, (r, c, u, v) in enumerate(wanted):
            assert (found.u_px[k, n], found.v_px[k, n]) == pytest.approx((u, v))
            assert found.confidence[k, n] == confidence[k, r, c]
            assert found.depth_m[k, n] == depth_m[k, r, c]
            assert found.class_id[k, n] == class_id[k, r, c]
            sigma = 2**0.5 * depth_m[k, r, c] * spread[k, r, c]
            assert found.sigma_depth_m[k, n] == pytest.approx(sigma)
