"""Labels without depth train confidence and offset only, and are scored in pixels only."""

import numpy as np
import torch

from dmrl.geometry.frames import build_grid_label
from dmrl.learn.data.batches import ExampleSet
from dmrl.learn.data.targets import build_targets
from dmrl.learn.inference.detection_metrics import compute_metrics, score_detections
from dmrl.learn.inference.matching import Points
from dmrl.learn.training.losses import LossSettings, compute_loss_terms, depth_loss
from dmrl.learn.training.validation import select_visible_labels

SHAPE = (28, 40)


def build_robots(*rows: tuple[float, float, float, float]) -> torch.Tensor:
    """Return labels (1, n, 11) of one image from rows of u, v, depth and sigma of the depth."""
    out = np.full((1, len(rows), 11), np.nan, np.float32)
    for k, (u, v, depth, sigma) in enumerate(rows):
        out[0, k, :6] = (u, v, depth, 0, 0, sigma)
    return torch.from_numpy(out)


def build_output(value: float) -> dict[str, torch.Tensor]:
    """Return outputs (1, rows, columns) of a network, each with this value everywhere."""
    names = ("confidence", "log_depth", "offset_u", "offset_v")
    return {name: torch.full((1, *SHAPE), value, requires_grad=True) for name in names}


def test_unknown_depth_is_masked_under_every_label_noise_and_width() -> None:
    both = build_robots((20, 20, 0, np.inf), (200, 100, 1.5, 0.1))
    for noise in ("ignore", "weight", "soften"):
        for sigma in (0.0, 1.0):
            made = build_targets(both, SHAPE, sigma_cells=sigma, label_noise=noise)
            assert all(torch.isfinite(part).all() for part in made if part is not None)
            assert made.confidence[0, 2, 2] > 0.4
            assert made.offset_weight[0, 2, 2] > 0
            assert made.weight[0, 2, 2] == 0
            assert made.weight[0, 12, 25] > 0
            assert made.depth_m[0, 12, 25] == 1.5


def test_the_loss_has_no_gradient_where_the_depth_is_unknown() -> None:
    targets = build_targets(build_robots((20, 20, 0, np.inf)), SHAPE, sigma_cells=1.0)
    for kind in ("squared", "log"):
        out = build_output(0.3)
        loss = depth_loss(out["log_depth"], targets.depth_m, targets.weight, kind)
        loss.backward()
        assert loss == 0
        assert not out["log_depth"].grad.any()
    out = build_output(0.3)
    compute_loss_terms(out, targets, LossSettings()).sum().backward()
    assert out["confidence"].grad[0, 2, 2] != 0
    assert out["offset_u"].grad[0, 2, 2] != 0
    assert not out["log_depth"].grad.any()


def test_label_with_depth_wins_within_a_cell() -> None:
    for order in (1, -1):
        rows = ((20.0, 20.0, 0.0, np.inf), (21.0, 20.0, 3.0, 0.0))[::order]
        made = build_targets(build_robots(*rows), SHAPE, sigma_cells=0.0)
        assert made.depth_m[0, 2, 2] == 3
        assert made.weight[0, 2, 2] == 1
        uv, depth_m = np.array([row[:2] for row in rows]), np.array([row[2] for row in rows])
        assert build_grid_label(uv, depth_m)[:, 2, 2].tolist() == [1, 3]


def test_labels_without_depth_count_in_pixel_errors_only() -> None:
    found = build_robots((20, 20, 0, np.inf), (200, 100, 1.5, 0.1)).numpy()
    examples = ExampleSet([np.zeros((1, 224, 320, 3), np.uint8)], found)
    labels = select_visible_labels(examples)
    assert np.isnan(labels.depth_m[0]) and labels.depth_m[1] == 1.5
    detections = Points(
        np.zeros(2, int),
        np.array([21.0, 200.0]),
        np.array([20.0, 100.0]),
        np.array([9.0, 1.7]),
        np.array([0.9, 0.8]),
    )
    scored = score_detections(1, labels, detections)
    every = compute_metrics(scored, (0.0, np.inf), 0.5, np.ones((1, 1)))
    assert every["recall"] == 1 and every["mean_px"] == 0.5
    np.testing.assert_allclose(every["depth_mae_m"], 0.2)
    np.testing.assert_allclose(every["depth_rmse_m"], 0.2)
    near = compute_metrics(scored, (1.0, 2.0), 0.5, np.ones((1, 1)))
    assert near["mean_px"] == 0
