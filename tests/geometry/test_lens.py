"""The plumb-bob lens model: distortion, its inverse and derivatives, and where it folds."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmrl.geometry.frames import AIDECK
from dmrl.geometry.lens import distort, undistort


def test_folded_lens_model_gives_no_pixel_far_out() -> None:
    bent, _ = distort(np.array([[0.1, 0.0], [3.0, 0.0]]), (-0.3,))
    assert np.isfinite(bent[0]).all()
    assert np.isnan(bent[1]).any()


def test_undistort_inverts_distort() -> None:
    plane = np.random.default_rng(0).uniform(-0.9, 0.9, (100, 2))
    bent, _ = distort(plane, AIDECK.distortion)
    assert np.allclose(undistort(bent, AIDECK.distortion), plane, atol=1e-9)


PLANE = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 2))
LENS = (0.12, -0.05, 0.013, -0.021, 0.03)


def test_lens_model_equals_opencv() -> None:
    points = np.column_stack([PLANE, np.ones(len(PLANE))])
    wanted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(LENS))
    np.testing.assert_allclose(distort(PLANE, LENS)[0], wanted[:, 0], atol=1e-12)
    np.testing.assert_allclose(distort(PLANE, LENS[:2])[0], distort(PLANE, (*LENS[:2], 0, 0, 0))[0])


def test_distortion_derivatives_equal_finite_differences() -> None:
    _, jacobian = distort(PLANE, LENS)
    for k, step in enumerate(1e-6 * np.eye(2)):
        slope = (distort(PLANE + step, LENS)[0] - distort(PLANE - step, LENS)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[..., k], slope, atol=1e-7)


@pytest.mark.parametrize("k1", [-0.3, -0.5])
def test_lens_folds_where_its_derivative_is_zero(k1: float) -> None:
    fold = np.sqrt(-1 / (3 * k1))  # where the derivative of r + k1 r^3 is zero
    inner, outer = distort(np.array([[0.999 * fold, 0.0], [0.0, 1.001 * fold]]), (k1,))[0]
    assert np.isfinite(inner).all()
    assert np.isnan(outer).any()


@given(
    st.tuples(*[st.floats(-0.08, 0.08)] * 2, *[st.floats(-0.02, 0.02)] * 2, st.floats(-0.02, 0.02)),
    st.lists(st.tuples(*[st.floats(-0.7, 0.7)] * 2), min_size=1, max_size=5),
)
def test_every_mild_lens_can_be_undone(
    lens: tuple[float, ...], places: list[tuple[float, float]]
) -> None:
    plane = np.array(places)
    np.testing.assert_allclose(undistort(distort(plane, lens)[0], lens), plane, atol=1e-9)


def test_distortion_is_nan_where_the_model_folds() -> None:
    at_fold, _ = distort(np.array([[1.0, 0.0], [0.999, 0.0]]), (0.0, -0.2))
    assert np.isnan(at_fold[0]).all() and np.isfinite(at_fold[1]).all()
