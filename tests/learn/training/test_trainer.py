"""Trainings: what they learn, log and refuse."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from dmrl.datasets.training import describe_step
from dmrl.errors import SettingError
from dmrl.learn.data.batches import CLASS_ID, ROBOT_FIELDS, ExampleSet, collate
from dmrl.learn.inference.decode_grids import decode
from dmrl.learn.inference.loaded_model import Model, save_model
from dmrl.learn.inference.threshold import select_threshold
from dmrl.learn.networks.architectures import build_network
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.train_step import LOSS_NAMES, WeightEma, compute_losses
from dmrl.learn.training.trainer import Trainer, build_initial_network, select_device
from dmrl.learn.training.validation import score_examples

from ..fitting import EVERYTHING, SETTINGS, draw_dots, train


@pytest.mark.heavy
def test_the_seed_decides_the_bytes_of_the_weights(examples: ExampleSet, tmp_path: Path) -> None:
    weights = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(examples, tmp_path / name, replace(SETTINGS, epochs=1, seed=seed))
        weights.append((tmp_path / name / "model.safetensors").read_bytes())
    assert weights[0] == weights[1] != weights[2]


@pytest.mark.heavy
def test_progress_shows_no_loss_until_an_epoch_has_read_one(
    examples: ExampleSet, tmp_path: Path
) -> None:
    settings = replace(SETTINGS, epochs=2, batch_size=1)
    network = build_initial_network(settings, examples)
    training = Trainer(network, examples, settings, tmp_path, identity="dots")
    lines = [describe_step(step, 2) for step in training.train_steps()]
    assert lines[0] == "Epoch 1/2" and "Epoch 2/2" in lines
    assert lines[-1].startswith("Epoch 2/2, loss ") and not [x for x in lines if "nan" in x]


@pytest.mark.heavy
def test_locanet_learns_to_detect_a_dot(tmp_path: Path) -> None:
    examples = draw_dots(150)
    settings = replace(SETTINGS, epochs=12, learning_rate=3e-3)
    training, network = train(examples, tmp_path / "run", settings)
    losses = [epoch["loss"] for epoch in training.history]
    assert losses[-1] < losses[0] / 5
    images: NDArray[np.uint8] = np.concatenate(list(examples.pixels))
    found = decode(*Model(network, "locanet").grids(images))
    best = (found.v_px[:, 0] // 8 * 6 + found.u_px[:, 0] // 8).astype(int)
    right = best == examples.robots[:, 0, 1] // 8 * 6 + examples.robots[:, 0, 0] // 8
    assert right.mean() > 0.95
    np.testing.assert_allclose(found.depth_m[right, 0], 1.5, atol=0.3)


@pytest.mark.slow
def test_dmrl_nano_learns_to_locate_a_dot_within_its_cell(tmp_path: Path) -> None:
    examples = draw_dots(64)
    settings = TrainConfig(
        epochs=20, batch_size=8, ema_steps=40, rotation_deg=0.0, blur_share=0.0, device="cpu"
    )
    _, network = train(examples, tmp_path / "run", settings)
    scored = score_examples(network, examples)
    assert np.median(scored.label_error.norm_px) < 1.0
    assert np.nanmean(np.abs(scored.label_error.depth_m)) < 0.15
    threshold = select_threshold(scored)
    assert threshold is not None
    assert 0.05 < threshold < 0.95


@pytest.mark.heavy
def test_kept_weights_are_averaged_over_ema_steps(tmp_path: Path) -> None:
    examples, settings = draw_dots(12), replace(EVERYTHING, epochs=2)
    _, last = train(examples, tmp_path / "last", replace(settings, ema_steps=0))
    _, mean = train(examples, tmp_path / "mean", settings)
    _, one = train(examples, tmp_path / "one", replace(settings, ema_steps=1))
    for a, b, c in zip(last.parameters(), mean.parameters(), one.parameters(), strict=True):
        assert not torch.equal(a, b)
        assert torch.isfinite(b).all()
        torch.testing.assert_close(a.detach(), c, rtol=0.2, atol=0.05)


def test_the_last_epochs_are_without_geometric_augmentation() -> None:
    settings = TrainConfig(epochs=10, plain_epochs=3, paste=1.0)
    assert settings.augmentation(6) == replace(settings, plain_epochs=0).augmentation(9)
    plain = settings.augmentation(7)
    assert (plain.mosaic_share, plain.paste, plain.rotation_deg) == (0, 0, 0)
    assert plain.zoom == (1.0, 1.0)
    assert (plain.flip_share, plain.colour) == (settings.flip_share, settings.colour)


@pytest.mark.parametrize("frozen", [0, 1])
@pytest.mark.heavy
def test_frozen_norms_learn_scales_but_keep_their_statistics(
    examples: ExampleSet, tmp_path: Path, frozen: int
) -> None:
    settings = replace(SETTINGS, epochs=2, frozen_norm_epochs=frozen)
    training = Trainer(build_initial_network(settings, examples), examples, settings, tmp_path)
    seen: list[dict[str, torch.Tensor]] = []
    for number, _ in enumerate(training.train_steps(), start=1):
        if number % 7 == 0:  # An epoch of 20 images has 7 steps.
            seen.append({k: v.clone() for k, v in training.network.state_dict().items()})
    first, second = seen
    statistics = {name for name in first if "running_" in name}
    assert statistics
    for name in first:
        if name in statistics:
            assert torch.equal(first[name], second[name]) == bool(frozen)
    scales = [name for name in first if "norms" in name and name.endswith("weight")]
    assert scales
    assert not any(torch.equal(first[name], second[name]) for name in scales)


@pytest.mark.heavy
def test_distillation_loss_is_zero_for_an_identical_teacher(examples: ExampleSet) -> None:
    settings = TrainConfig(distill_share=1.0, device="cpu")
    batch = collate(examples, np.arange(8))
    student = build_network("dmrl-nano", seed=1).eval()
    teacher = build_network("dmrl-large", seed=2).eval()
    for network in (student, teacher):
        with torch.no_grad():
            network.head.bias[1] = 1.0  # type: ignore[union-attr, index, operator]
    itself = compute_losses(student, batch, settings, student)
    other = compute_losses(student, batch, settings, teacher)
    assert itself.tolist() == pytest.approx([0.0] * 6, abs=1e-6)
    assert (other[:3] > 1e-3).all()
    half = compute_losses(student, batch, replace(settings, distill_share=0.5), teacher)
    labels = compute_losses(student, batch, settings)
    torch.testing.assert_close(half, (other + labels) / 2)


@pytest.mark.slow
def test_classes_and_the_spread_are_learnt(examples: ExampleSet, tmp_path: Path) -> None:
    # Squares of class 1 are grey, so that the classes differ.
    pixels: NDArray[np.uint8] = np.concatenate(list(draw_dots(64).pixels))
    robots = draw_dots(64).robots
    grey = robots[:, 0, CLASS_ID] == 1
    pixels[grey] = np.minimum(pixels[grey], 120)
    settings = TrainConfig(
        epochs=15,
        batch_size=8,
        ema_steps=20,
        rotation_deg=0.0,
        blur_share=0.0,
        noise=0.0,
        device="cpu",
        spread_weight=1.0,
        classes=("a", "b"),
    )
    _, network = train(ExampleSet([pixels], robots), tmp_path / "run", settings)
    found = decode(*Model(network, "dmrl-nano").grids(pixels))
    assert (found.class_id[:, 0] == grey).mean() > 0.9
    error_m = np.abs(found.depth_m[:, 0] - 1.5)
    assert 0.2 < np.median(error_m) / np.median(found.sigma_depth_m[:, 0]) < 2


@pytest.mark.heavy
def test_a_loss_of_nan_stops_the_training(examples: ExampleSet, tmp_path: Path) -> None:
    wild = replace(SETTINGS, learning_rate=1e7, warmup_epochs=0)
    with pytest.raises(SettingError, match=r"the loss is nan in epoch 1, step 7\. Lower"):
        train(examples, tmp_path / "run", wild)


@pytest.mark.heavy
def test_tensorboard_gets_loss_and_learning_rate(examples: ExampleSet, tmp_path: Path) -> None:
    train(examples, tmp_path / "run")
    log = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    log.Reload()
    assert set(log.Tags()["scalars"]) == {"loss/train", "learning_rate"}
    assert [event.step for event in log.Scalars("loss/train")] == [7, 14, 21, 28]


@pytest.mark.heavy
def test_validation_does_not_change_the_weights(examples: ExampleSet, tmp_path: Path) -> None:
    weights = []
    for name, watched in (("without", None), ("with", examples)):
        (tmp_path / name).mkdir()
        network = build_initial_network(SETTINGS, examples)
        training = Trainer(network, examples, SETTINGS, tmp_path / name, validation=watched)
        assert sum(1 for _ in training.train_steps()) == 28
        assert all(("validation_loss" in epoch) == bool(watched) for epoch in training.history)
        save_model(Model(network, "locanet"), tmp_path / name)
        weights.append((tmp_path / name / "model.safetensors").read_bytes())
    assert weights[0] == weights[1]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("epochs", -1),
        ("batch_size", 0),
        ("learning_rate", 0.0),
        ("final_learning_rate", 1.0),
        ("warmup_epochs", -1),
        ("depth_weight", -1.0),
        ("threshold", 1.5),
        ("weight_decay", -0.1),
        ("ema_steps", -1),
        ("target_sigma_cells", -0.5),
        ("mosaic_share", 1.01),
        ("validation_share", 0.6),
        ("zoom", (0.0, 1.0)),
        ("zoom", (2.0, 1.0)),
        ("intrinsics", (120.0, 0.0, 160.0, 112.0)),
        ("shares", {"*": -1.0}),
    ],
)
def test_settings_out_of_range_are_named(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=r"learning_rate: must|" + name):
        replace(TrainConfig(), **{name: value})  # type: ignore[arg-type]


def test_images_that_do_not_fit_the_network_are_refused(examples: ExampleSet) -> None:
    odd = ExampleSet([p[:, :30] for p in examples.pixels], examples.robots)
    with pytest.raises(
        SettingError, match="48 x 30 px do not divide into cells of 8 px, as locanet"
    ):
        build_initial_network(SETTINGS, odd)
    none = ExampleSet([p[:0] for p in examples.pixels], examples.robots[:0])
    with pytest.raises(SettingError, match="no images to train on"):
        build_initial_network(SETTINGS, none)


def test_missing_cuda_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert select_device("auto").type == "cpu"
    with pytest.raises(SettingError, match="no CUDA device here"):
        select_device("cuda")


@pytest.mark.heavy
def test_weight_ema_follows_early_steps_and_averages_later_ones() -> None:
    network = build_network("dmrl-nano")
    mean = WeightEma(network, 100)
    expected = 0.0
    for step in range(1, 300):
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.fill_(float(step))
        mean.update(step)
        share = min(1.0, max(1 / 100, 10 / (9 + step)))
        expected += share * (step - expected)
        if step in (1, 2, 50, 299):
            for parameter in mean.network.parameters():
                assert float(parameter.flatten()[0]) == pytest.approx(expected, rel=1e-4)
    assert float(next(mean.network.parameters()).flatten()[0]) < 299 - 20


def test_distillation_weight_is_the_configured_share(examples: ExampleSet) -> None:
    settings = replace(SETTINGS, architecture="dmrl-nano")
    pupil, teacher = (build_network("dmrl-nano", seed=seed).eval() for seed in (1, 2))
    batch = collate(examples, [0, 1])
    with torch.no_grad():
        alone = compute_losses(pupil, batch, settings)
        none, half, all_ = (
            compute_losses(pupil, batch, replace(settings, distill_share=share), teacher)
            for share in (0.0, 0.25, 1.0)
        )
    torch.testing.assert_close(none, alone)
    assert not torch.allclose(all_, alone)
    torch.testing.assert_close(half, 0.75 * none + 0.25 * all_)


@pytest.mark.parametrize(("width", "height", "fits"), [(48, 32, 1), (44, 32, 0), (48, 28, 0)])
def test_width_and_height_must_divide_into_cells(width: int, height: int, fits: int) -> None:
    robots = np.full((1, 1, len(ROBOT_FIELDS)), np.nan, np.float32)
    images = ExampleSet([np.zeros((1, height, width, 3), np.uint8)], robots)
    if fits:
        assert build_initial_network(SETTINGS, images).stride_px == 8
    else:
        with pytest.raises(SettingError, match=f"images of {width} x {height} px do not divide"):
            build_initial_network(SETTINGS, images)


def test_loss_terms_have_a_fixed_order() -> None:
    names = ("confidence", "depth", "offset", "spread", "class", "consistency")
    assert tuple(f"{name}_loss" for name in names) == LOSS_NAMES
