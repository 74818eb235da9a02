"""Demosaicing of raw images into the input of a network."""

import numpy as np
import pytest

from dmrl.deploy.bayer_input import demosaic, to_mosaic

PHASES = [(row, col) for row in (0, 1) for col in (0, 1)]


@pytest.mark.parametrize(("row", "col"), PHASES)
def test_demosaicing_keeps_measured_values(row: int, col: int) -> None:
    image = np.random.default_rng(0).integers(0, 256, (9, 12, 3), dtype=np.uint8)
    raw = to_mosaic(image, red_row=row, red_col=col)
    seen = demosaic(raw, red_row=row, red_col=col)
    assert np.array_equal(to_mosaic(seen, red_row=row, red_col=col), raw)


def test_demosaicing_keeps_uniform_colour() -> None:
    image = np.broadcast_to(np.array([200, 90, 31], np.uint8), (8, 10, 3))
    assert np.array_equal(demosaic(to_mosaic(image)), image)


def test_demosaicing_rounds_halves_up_and_mirrors_the_border() -> None:
    raw = np.array([[10, 20, 30, 40], [50, 60, 70, 81], [90, 100, 110, 120]], np.uint8)
    red, green, blue = demosaic(raw).transpose(2, 0, 1)
    assert red[0].tolist() == [10, 20, 30, 30]  # the last column is mirrored at the border
    assert green[0, 0] == (20 + 20 + 50 + 50 + 2) // 4
    assert blue[1].tolist() == [60, 60, 71, 81]  # 70.5 is rounded up
    assert red[1, 1] == (10 + 30 + 90 + 110 + 2) // 4


def test_grey_is_a_weighted_sum_of_colours() -> None:
    image = np.broadcast_to(np.array([255, 0, 0], np.uint8), (4, 4, 3))
    assert (demosaic(to_mosaic(image), channels=1) == (77 * 255 + 128) >> 8).all()
