"""Training steps: their images, learning rates, losses and logged curves."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dmrl.learn.data.batches import Batch, ExampleSet, collate
from dmrl.learn.networks.architectures import Network, build_network
from dmrl.learn.training import train_step as steps
from dmrl.learn.training import trainer
from dmrl.learn.training.train_step import LOSS_NAMES, compute_losses, train_step
from dmrl.learn.training.trainer import Trainer, build_initial_network, learning_rate_at

from .fitting import PUBLISHED, SETTINGS, draw_dots


def test_published_learning_rate_rises_for_two_epochs_and_then_falls() -> None:
    rates = [learning_rate_at(step, 100, PUBLISHED) for step in range(1, 1501)]
    assert rates[0] == pytest.approx(1e-3 / 200)
    assert rates[99] == pytest.approx(0.5e-3)
    assert max(rates) == rates[199] == pytest.approx(1e-3)
    assert rates[849] == pytest.approx((1e-3 + 1e-6) / 2)
    assert rates[-1] == pytest.approx(1e-6)


def test_gradients_are_cleared_between_steps(examples: ExampleSet) -> None:
    network = build_network("locanet").train()
    optimizer = torch.optim.SGD(network.parameters(), lr=0.0)
    batch = collate(examples, [0, 1])
    sizes = []
    for _ in range(2):
        train_step(network, optimizer, batch, SETTINGS, 0.0)
        sizes.append([float(p.grad.norm()) for p in network.parameters() if p.grad is not None])
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-3)


@pytest.mark.parametrize("able", [True, False])
def test_bfloat16_is_computed_only_on_processors_that_have_it(
    examples: ExampleSet, monkeypatch: pytest.MonkeyPatch, able: bool
) -> None:
    monkeypatch.setattr(steps, "computes_bfloat16", lambda device: able)
    network, batch = build_network("locanet"), collate(examples, [0])
    half, single = (
        compute_losses(network, batch, replace(SETTINGS, precision=precision))
        for precision in ("bfloat16", "float32")
    )
    assert torch.equal(half, single) != able


def test_epochs_differ_in_order_and_are_reproducible(examples: ExampleSet, tmp_path: Path) -> None:
    training = Trainer(build_initial_network(SETTINGS, examples), examples, SETTINGS, tmp_path)
    seen = [
        torch.cat([b.images for b in training._iter_batches(epoch, None)]) for epoch in (0, 0, 1)
    ]
    assert torch.equal(seen[0], seen[1])
    assert not torch.equal(seen[0], seen[2])


@pytest.mark.heavy
def test_epoch_images_set_the_steps_of_an_epoch_of_a_small_set(
    examples: ExampleSet, tmp_path: Path
) -> None:
    settings = replace(SETTINGS, epochs=2, epoch_images=3 * SETTINGS.batch_size + 1)
    few = examples.select(np.arange(len(examples)) < 5)
    training = Trainer(build_initial_network(settings, few), few, settings, tmp_path)
    assert training.steps_left == 8
    sizes = [len(batch.images) for batch in training._iter_batches(0, None)]
    assert sizes == [settings.batch_size] * 3 + [1]
    assert [step.epoch for step in training.train_steps()] == [1] * 4 + [2] * 4
    assert all(np.isfinite(epoch["loss"]) for epoch in training.history)


@pytest.mark.heavy
def test_reported_loss_is_the_mean_since_the_last_report(
    examples: ExampleSet, tmp_path: Path
) -> None:
    settings = replace(SETTINGS, epochs=2)
    training = Trainer(build_initial_network(settings, examples), examples, settings, tmp_path)
    shown = [step.loss for step in training.train_steps()]
    # An epoch has seven batches, the last of two images, and reports once, at its end.
    assert [shown[6], shown[13]] == pytest.approx([epoch["loss"] for epoch in training.history])


def test_logged_curves_have_the_right_step_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows: list[tuple[str, float, int]] = []

    @contextmanager
    def opened(_: Path, first_step: int) -> Iterator[Callable[..., None]]:
        rows.append(("first", 0.0, first_step))
        yield lambda *row: rows.append(row)

    monkeypatch.setattr(trainer.boards, "open_log", opened)
    # An epoch of 7 images has three steps, the last of one image.
    settings, images = replace(SETTINGS, epochs=2), draw_dots(7)
    network = build_initial_network(settings, images)
    training = Trainer(network, images, settings, tmp_path, validation=draw_dots(3))
    assert training.steps_left == 6
    assert [step.epoch for step in training.train_steps()] == [1, 1, 1, 2, 2, 2]
    assert training.steps_left == 0
    found = {name: [row[1:] for row in rows if row[0] == name] for name, *_ in rows}
    assert found.pop("first") == [(0.0, 1)]
    assert [step for _, step in found["loss/train"]] == [3, 6]
    for name, curve in found.items():
        if name == "learning_rate":
            assert curve == [(learning_rate_at(step, 3, settings), step) for step in (3, 6)]
        else:
            key = "loss" if name == "loss/train" else name.replace("/", "_", 1)
            wanted = [
                (pytest.approx(training.history[k][key], rel=1e-5), 3 * k + 3) for k in (0, 1)
            ]
            assert curve == wanted
    shown = {name.replace("/", "_", 1) for name in found} - {"loss_train", "learning_rate"}
    assert (
        shown == {name for name in training.history[0] if name.startswith("validation_")} != set()
    )


def test_trainer_passes_recipe_settings_to_each_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Replaced steps record what each of three epochs would give them, and compute nothing."""
    images, asked = draw_dots(8), []
    settings = replace(SETTINGS, epochs=3, frozen_norm_epochs=1, ema_steps=5, hard_share=0.25)
    teacher = build_network("dmrl-nano").train()

    def step(network: Network, _: object, batch: Batch, *rest: object) -> torch.Tensor:
        norms = {m.training for m in network.modules() if isinstance(m, torch.nn.BatchNorm2d)}
        asked.append((batch.robots[:, 0, :2].tolist(), network.training, norms, rest))
        return torch.full((len(LOSS_NAMES),), float(len(asked)))

    updated, hard = [], []
    monkeypatch.setattr(trainer, "train_step", step)
    monkeypatch.setattr(trainer, "save_checkpoint", lambda *_: None)
    monkeypatch.setattr(trainer.boards, "open_log", lambda *_: nullcontext(lambda *_: None))
    monkeypatch.setattr(trainer, "mine_hard_negatives", lambda *given: hard.append(given))
    monkeypatch.setattr(trainer.WeightEma, "update", lambda _, at: updated.append(at))
    shares = np.ones(8)
    training = Trainer(
        build_initial_network(settings, images),
        images,
        settings,
        tmp_path,
        teacher=teacher,
        shares=shares,
    )
    shown = [(step.epoch, step.loss) for step in training.train_steps()]
    assert updated == list(range(1, 10))
    assert [epoch for epoch, _ in shown] == [1, 1, 1, 2, 2, 2, 3, 3, 3]
    every = sorted(images.robots[:, 0, :2].tolist())
    for epoch in range(3):
        mine = asked[3 * epoch : 3 * epoch + 3]
        assert [len(at) for at, *_ in mine] == [3, 3, 2]
        assert sorted(at for rows, *_ in mine for at in rows) == every
        assert {training for _, training, *_ in mine} == {True}
        assert [norms for _, _, norms, _ in mine] == [{epoch < 2}] * 3
        ends = np.array([3 * epoch + k for k in (1, 2, 3)])
        means = float((ends * [3, 3, 2]).sum() / 8)
        assert training.history[epoch] == pytest.approx(
            {"loss": len(LOSS_NAMES) * means, **dict.fromkeys(LOSS_NAMES, means)}
        )
        assert shown[3 * epoch + 2][1] == pytest.approx(len(LOSS_NAMES) * means)
    for number, (*_, (given, rate, group, share, taught, *_)) in enumerate(asked, start=1):
        assert (given, rate) == (settings, learning_rate_at(number, 3, settings))
        assert (group.size, share) == (1, 1.0)  # type: ignore[attr-defined]
        assert taught is teacher and not teacher.training
    assert len(hard) == 3
    for network, examples, before, share in hard:
        assert network is training.network and examples is images
        assert before is shares and share == 0.25


@pytest.mark.parametrize("warmup", [0, 1, 2])
def test_learning_rate_is_a_linear_warmup_and_half_a_cosine(warmup: int) -> None:
    settings = replace(
        SETTINGS, epochs=4, warmup_epochs=warmup, learning_rate=0.5, final_learning_rate=0.1
    )
    rates = [learning_rate_at(step, 5, settings) for step in range(1, 21)]
    up, rest = 5 * warmup, 20 - 5 * warmup
    wanted = [0.5 * step / up for step in range(1, up)]
    wanted += [0.1 + 0.2 * (1 + np.cos(np.pi * k / rest)) for k in range(rest + 1)]
    assert rates == pytest.approx(wanted[-20:])
