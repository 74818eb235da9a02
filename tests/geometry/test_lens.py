"""The plumb-bob model."""

import numpy as np

from dmrl.geometry.frames import AIDECK
from dmrl.geometry.lens import distort, undistort


def test_a_lens_that_folds_back_gives_no_pixel_out_there() -> None:
    bent, _ = distort(np.array([[0.1, 0.0], [3.0, 0.0]]), (-0.3,))
    assert np.isfinite(bent[0]).all()
    assert np.isnan(bent[1]).any()


def test_undistorting_undoes_the_lens() -> None:
    plane = np.random.default_rng(0).uniform(-0.9, 0.9, (100, 2))
    bent, _ = distort(plane, AIDECK.distortion)
    assert np.allclose(undistort(bent, AIDECK.distortion), plane, atol=1e-9)
