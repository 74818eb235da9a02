"""Windows of convolutions and max-pools, compared with loops over all positions."""

import numpy as np
import pytest

from dmrl.deploy.int8.windows import extract_taps, max_pool_2x2

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("kernel", [1, 2, 3])
@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize("dilation", [1, 2])
def test_convolution_taps_are_in_raster_order(kernel: int, stride: int, dilation: int) -> None:
    x = RNG.integers(-9, 9, (2, 3, 11, 8))
    found = extract_taps(x, kernel, stride, dilation)
    reach = dilation * (kernel - 1)
    rows, cols = range(0, 11 - reach, stride), range(0, 8 - reach, stride)
    assert found.shape == (2, 3, kernel * kernel, len(rows), len(cols))
    for i, top in enumerate(rows):
        for j, left in enumerate(cols):
            seen = x[
                ..., top : top + reach + 1 : dilation, left : left + reach + 1 : dilation
            ].reshape(2, 3, -1)
            assert (found[..., i, j] == seen).all()


@pytest.mark.parametrize("shape", [(4, 6), (5, 7), (2, 3)])
def test_max_pool_takes_the_largest_of_each_block_of_four(shape: tuple[int, int]) -> None:
    x = RNG.integers(-9, 9, (2, *shape))
    found = max_pool_2x2(x)
    assert found.shape == (2, shape[0] // 2, shape[1] // 2)
    for row in range(shape[0] // 2):
        for col in range(shape[1] // 2):
            block = x[:, 2 * row : 2 * row + 2, 2 * col : 2 * col + 2]
            assert (found[:, row, col] == block.reshape(2, -1).max(axis=1)).all()
