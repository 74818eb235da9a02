"""Targets of the cells of a grid, from labels and from a teacher."""

import numpy as np
import pytest
import torch

from dmrl.geometry.frames import build_grid_label
from dmrl.learn.data.batches import CLASS_ID, ROBOT_FIELDS
from dmrl.learn.data.targets import LabelNoise, build_targets, build_teacher_targets

SHAPE = (28, 40)


def build_robots(*rows: tuple[float, ...]) -> torch.Tensor:
    """Return labels (1, n, fields) from rows of u, v, depth and, if given, sigmas."""
    out = torch.full((1, len(rows), len(ROBOT_FIELDS)), float("nan"))
    for k, row in enumerate(rows):
        out[0, k, 3:6] = 0
        out[0, k, : len(row)] = torch.tensor(row)
    return out


def test_targets_of_zero_width_equal_the_grid_labels_of_the_paper() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        found = np.c_[rng.uniform(-20, 340, 6), rng.uniform(-20, 240, 6), rng.uniform(0.2, 2, 6)]
        found[0, :2] = 64, 80  # It lies on a border of cells.
        found[2, :2] = found[1, :2]  # Two share one cell.
        got = build_targets(build_robots(*found), SHAPE, sigma_cells=0)
        confidence, depth_m = build_grid_label(found[:, :2], found[:, 2])
        np.testing.assert_array_equal(got.confidence[0], confidence)
        np.testing.assert_array_equal(got.weight[0], confidence)
        np.testing.assert_allclose(got.depth_m[0].numpy() * confidence, depth_m, rtol=1e-6)


def test_offset_of_each_near_cell_points_to_the_centre() -> None:
    got = build_targets(build_robots((101.5, 50.25, 1.3)), SHAPE, sigma_cells=0.7)
    rows, cols = torch.nonzero(got.weight[0], as_tuple=True)
    assert len(rows) > 4
    u = (cols + 0.5 + got.offset[0, 0, rows, cols]) * 8
    v = (rows + 0.5 + got.offset[0, 1, rows, cols]) * 8
    torch.testing.assert_close(u, torch.full_like(u, 101.5))
    torch.testing.assert_close(v, torch.full_like(v, 50.25))
    assert got.confidence[0].argmax() == 6 * 40 + 12
    torch.testing.assert_close(got.depth_m[0, rows, cols], torch.full_like(u, 1.3))


def test_each_cell_belongs_to_the_nearest_centre() -> None:
    got = build_targets(build_robots((100, 100, 1.0), (116, 100, 2.0)), SHAPE, sigma_cells=0.7)
    assert got.depth_m[0, 12, 11:16].tolist() == pytest.approx([1, 1, 1, 2, 2])


def test_without_robots_presence_and_weights_are_zero() -> None:
    got = build_targets(build_robots((float("nan"), 0, 0), (50, 50, -1)), SHAPE, sigma_cells=0.7)
    assert all((x == 0).all() for x in (got.confidence, got.weight, got.offset))
    assert (got.confidence_weight == 1).all()
    assert all(torch.isfinite(x).all() for x in got if x is not None)


def test_noisy_labels_weigh_less_or_are_spread_over_cells() -> None:
    exact, noisy = (100.0, 100.0, 1.0), (100.0, 100.0, 1.0, 8.0, 8.0, 0.1)
    plain = build_targets(build_robots(noisy), SHAPE, sigma_cells=0.7)
    for one, other in zip(
        plain, build_targets(build_robots(exact), SHAPE, sigma_cells=0.7), strict=True
    ):
        torch.testing.assert_close(one, other)
    weighted = build_targets(build_robots(noisy), SHAPE, sigma_cells=0.7, label_noise="weight")
    torch.testing.assert_close(weighted.weight, plain.weight / 2)
    torch.testing.assert_close(weighted.offset_weight, plain.weight / 2)
    assert weighted.confidence_weight[0, 12, 12] == 0.5
    assert weighted.confidence_weight[0, 0, 0] == 1
    softened = build_targets(build_robots(noisy), SHAPE, sigma_cells=0.7, label_noise="soften")
    assert softened.confidence.max() < 0.5 * plain.confidence.max()
    # Softening spreads presence and keeps its sum over cells.
    torch.testing.assert_close(softened.confidence.sum(), plain.confidence.sum(), rtol=1e-2, atol=0)


def test_cells_of_a_robot_have_its_class() -> None:
    near, far, strange = build_robots((100, 100, 1.0), (116, 100, 2.0), (200, 50, 1.0))[0].unbind()
    near[CLASS_ID], far[CLASS_ID] = 0, 1
    got = build_targets(torch.stack((near, far, strange))[None], SHAPE, sigma_cells=0.7)
    assert got.class_id[0, 12, 11:16].tolist() == [0, 0, 0, 1, 1]
    # The robot without a class and empty cells have class -1.
    assert (got.class_id[0, :8] == -1).all()
    assert got.weight[0, 6, 25] > 0


def test_teacher_targets_take_all_confidences_but_only_sure_positions() -> None:
    labelled = build_targets(build_robots((100, 100, 1.0)), SHAPE, sigma_cells=0.7)
    said = torch.full((1, 4, *SHAPE), -6.0)
    said[0, :, 3, 5] = torch.tensor([0.5, 2.0, 0.2, -0.1])
    said[0, 1, 9, 9] = -3.0
    got = build_teacher_targets(("log_depth", "confidence", "offset_u", "offset_v"), said, labelled)
    assert got.confidence[0, 3, 5] == pytest.approx(1 / (1 + np.exp(-2)))
    assert got.confidence[0, 9, 9] == pytest.approx(1 / (1 + np.exp(3)))
    assert torch.nonzero(got.weight[0]).tolist() == [[3, 5]]
    assert got.depth_m[0, 3, 5] == pytest.approx(np.exp(0.5))
    assert got.offset[0, :, 3, 5].tolist() == pytest.approx([0.2, -0.1])


def test_presence_is_a_gaussian_of_the_distance_in_cells() -> None:
    got = build_targets(build_robots((100.0, 100.0, 1.0)), SHAPE, sigma_cells=0.7).confidence[0]
    for row, col in ((12, 12), (12, 13), (11, 11), (13, 10)):
        away = np.hypot(8 * (col + 0.5) - 100, 8 * (row + 0.5) - 100) / 8
        assert got[row, col] == pytest.approx(np.exp(-0.5 * (away / 0.7) ** 2), rel=1e-5)


@pytest.mark.parametrize("times", [0.5, 1.0, 2.0])
def test_the_weight_of_a_label_falls_with_the_square_of_its_sigma(times: float) -> None:
    noisy = build_robots((100.0, 100.0, 2.0, 8 * times, 8 * times, 0.3))
    exact = build_targets(noisy, SHAPE, sigma_cells=0.7)
    got = build_targets(noisy, SHAPE, sigma_cells=0.7, label_noise="weight")
    torch.testing.assert_close(got.offset_weight, exact.offset_weight / (1 + times**2))
    # A relative sigma of 0.1 halves the weight; 0.3 m of 2 m is 1.5 times that.
    torch.testing.assert_close(got.weight, exact.weight / (1 + 1.5**2))


def test_cells_below_a_tenth_of_presence_learn_no_depth() -> None:
    """With a width of one cell, presence exp(-d^2 / 2) is a tenth at d = 2.146 cells."""
    for off_cells, counts in ((2.1, True), (2.2, False)):
        centre = 100.0 + 8 * off_cells  # Cell 12 has its middle at 100 px.
        got = build_targets(build_robots((centre, 100.0, 2.0)), SHAPE, sigma_cells=1.0)
        presence = np.exp(-(off_cells**2) / 2)
        assert float(got.confidence[0, 12, 12]) == pytest.approx(presence, rel=1e-4)
        assert float(got.weight[0, 12, 12]) == pytest.approx(presence * counts, rel=1e-4)
        assert float(got.depth_m[0, 12, 12]) == (2.0 if counts else 1.0)
        assert got.offset[0, :, 12, 12].tolist() == pytest.approx([off_cells * counts, 0], abs=1e-4)


def test_the_relative_sigma_of_a_depth_weighs_only_the_depth() -> None:
    exact, blurred = (100.0, 100.0, 2.0, 0, 0, 0.0), (100.0, 100.0, 2.0, 0, 0, 0.2)
    for label_noise, depth, other in (("weight", 0.5, 1.0), ("ignore", 1.0, 1.0)):
        plain, noisy = (
            build_targets(build_robots(row), SHAPE, sigma_cells=0.7, label_noise=label_noise)  # type: ignore[arg-type]
            for row in (exact, blurred)
        )
        torch.testing.assert_close(noisy.weight, depth * plain.weight)
        torch.testing.assert_close(noisy.offset_weight, other * plain.offset_weight)
        torch.testing.assert_close(noisy.confidence_weight, plain.confidence_weight)


def test_the_sigma_in_pixels_is_the_root_mean_square_of_both_axes() -> None:
    exact, blurred = (100.0, 100.0, 2.0, 0, 0, 0), (100.0, 100.0, 2.0, 8 * 2**0.5, 0, 0)
    plain, noisy = (
        build_targets(build_robots(row), SHAPE, sigma_cells=0.7, label_noise="weight")
        for row in (exact, blurred)
    )
    torch.testing.assert_close(noisy.offset_weight, 0.5 * plain.offset_weight)
    assert noisy.confidence_weight[0, 12, 12] == pytest.approx(0.5)
    assert noisy.confidence_weight[0, 0, 0] == 1  # An empty cell is certain.
    soft = build_targets(build_robots(blurred), SHAPE, sigma_cells=0.7, label_noise="soften")
    wider = (0.49 + 1.0) ** 0.5
    assert float(soft.confidence[0, 12, 12] / soft.confidence[0, 12, 14]) == pytest.approx(
        np.exp(2**2 / (2 * wider**2)), rel=1e-3
    )
    assert float(soft.confidence[0, 12, 12]) == pytest.approx(0.49 / 1.49, rel=1e-3)


@pytest.mark.parametrize("label_noise", ["ignore", "weight", "soften"])
@pytest.mark.parametrize("seed", [0, 1])
def test_targets_equal_a_loop_over_cells(label_noise: LabelNoise, seed: int) -> None:
    rng, shape, sigma_cells = np.random.default_rng(seed), (5, 7), 0.8
    rows = np.full((2, 4, len(ROBOT_FIELDS)), np.nan, np.float32)
    for image in rows:
        for robot in image[: rng.integers(1, 5)]:
            robot[:2] = rng.uniform((-6, -6), (62, 46))
            robot[2:6] = *rng.uniform(0.4, 3, 1), *rng.uniform(0, 9, 2), rng.uniform(0, 0.4)
            robot[CLASS_ID] = rng.integers(3) if rng.random() < 0.7 else np.nan
    got = build_targets(
        torch.from_numpy(rows), shape, sigma_cells=sigma_cells, label_noise=label_noise
    )
    for n, row, col in np.ndindex(2, *shape):
        best = (0.0, 0.0, 0.0, 0.0, 1.0, 1.0, -1.0)
        for robot in rows[n]:
            u, v, depth, sigma_u, sigma_v, sigma_depth = map(float, robot[:6])
            if not np.isfinite(u):
                continue
            du, dv = u / 8 - col - 0.5, v / 8 - row - 0.5
            blur = ((sigma_u**2 + sigma_v**2) / 2) ** 0.5
            variance, height = sigma_cells**2, 1.0
            if label_noise == "soften":
                variance += (blur / 8) ** 2
                height = sigma_cells**2 / variance
            present = height * np.exp(-(du**2 + dv**2) / (2 * variance))
            trust, trust_depth = 1.0, 1.0
            if label_noise == "weight":
                trust = 1 / (1 + (blur / 8) ** 2)
                trust_depth = 1 / (1 + (sigma_depth / depth / 0.1) ** 2)
            kind = float(robot[CLASS_ID]) if np.isfinite(robot[CLASS_ID]) else -1.0
            if present > best[0]:
                best = present, depth, du, dv, trust, trust_depth, kind
        present, depth, du, dv, trust, trust_depth, kind = best
        near = present if present >= 0.1 else 0.0
        here = n, row, col
        assert got.confidence[here] == pytest.approx(present, rel=1e-4, abs=1e-6)
        assert got.confidence_weight[here] == pytest.approx(trust if present > 0.01 else 1.0)
        assert got.weight[here] == pytest.approx(near * trust_depth, rel=1e-4)
        assert got.offset_weight[here] == pytest.approx(near * trust, rel=1e-4)
        assert got.depth_m[here] == pytest.approx(depth if near else 1.0)
        wanted = [du, dv] if near else [0, 0]
        assert got.offset[n, :, row, col].tolist() == pytest.approx(wanted, abs=1e-4)
        assert got.class_id[here] == (kind if near else -1)
