import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from dmrl import recipe
from dmrl.errors import ModelError, SettingError
from dmrl.learn import fit
from dmrl.learn.batches import CLASS_ID, FIELDS, Batch, Examples, gathered
from dmrl.learn.checkpoint import has_checkpoint, remove_checkpoint
from dmrl.learn.decode import decode
from dmrl.learn.fit import Training, device_of, learning_rate_at, new_network
from dmrl.learn.model import Model, save_model
from dmrl.learn.network import Network, build
from dmrl.learn.settings import FitSettings
from dmrl.learn.step import LOSSES, Average, losses, train_step
from dmrl.learn.threshold import best_threshold
from dmrl.learn.validate import scores

PUBLISHED = recipe.load("locanet", "train", FitSettings)
SETTINGS = replace(PUBLISHED, epochs=4, batch_size=3, warmup_epochs=1, device="cpu")
EVERYTHING = FitSettings(
    epochs=3,
    batch_size=4,
    warmup_epochs=1,
    ema_steps=20,
    paste=1.0,
    plain_epochs=1,
    frozen_norm_epochs=1,
    label_noise="weight",
    precision="bfloat16",
    device="cpu",
)


def dots(count: int) -> Examples:
    """Dark images with one bright square, labelled at its centre, depth 1.5 m."""
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 40, (count, 32, 48, 3), np.uint8)
    robots = np.zeros((count, 1, len(FIELDS)), np.float32)
    for k, cell in enumerate(rng.integers(0, 24, count)):
        row, col = divmod(int(cell), 6)
        pixels[k, 8 * row + 2 : 8 * row + 6, 8 * col + 2 : 8 * col + 6] = 250
        box = (8 * col + 2, 8 * row + 2, 8 * col + 6, 8 * row + 6)
        robots[k, 0] = (8 * col + 4, 8 * row + 4, 1.5, 0, 0, 0, *box, k % 2)
    return Examples([pixels[:7], pixels[7:]], robots)


@pytest.fixture
def examples() -> Examples:
    return dots(20)


def trained(
    examples: Examples, folder: Path, settings: FitSettings = SETTINGS, *, resume: bool = False
) -> tuple[Training, Network]:
    folder.mkdir(exist_ok=True)
    network = new_network(settings, examples)
    training = Training(network, examples, settings, folder, identity="dots", resume=resume)
    for _ in training.steps():
        pass
    kept = Model(training.network, settings.architecture, training={"history": training.history})
    save_model(kept, folder)
    remove_checkpoint(folder)
    return training, training.network


def stopped(
    examples: Examples, folder: Path, epochs: int, steps: int, settings: FitSettings = SETTINGS
) -> None:
    """A training that dies some steps into an epoch."""
    folder.mkdir()
    network = new_network(settings, examples)
    training = Training(network, examples, settings, folder, identity="dots")
    walk = training.steps()
    for _ in range(epochs * -(-len(examples) // settings.batch_size) + steps):
        next(walk)
    walk.close()  # type: ignore[attr-defined]


@pytest.fixture(scope="module", params=[SETTINGS, EVERYTHING], ids=["published", "everything"])
def whole(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[FitSettings, Path]:
    """A training that nothing stopped: its settings and its folder."""
    folder = tmp_path_factory.mktemp("whole")
    trained(dots(9), folder, request.param)
    return request.param, folder


@pytest.mark.heavy
@pytest.mark.parametrize("steps", [1, 3])
def test_a_resumed_training_ends_with_the_same_bytes(
    tmp_path: Path, steps: int, whole: tuple[FitSettings, Path]
) -> None:
    settings, folder = whole
    stopped(dots(9), tmp_path / "resumed", 2, steps, settings)
    trained(dots(9), tmp_path / "resumed", settings, resume=True)
    for name in ("model.safetensors", "model.json"):
        assert (folder / name).read_bytes() == (tmp_path / "resumed" / name).read_bytes()


@pytest.mark.heavy
def test_same_seed_same_bytes_and_another_seed_others(examples: Examples, tmp_path: Path) -> None:
    weights = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        trained(examples, tmp_path / name, replace(SETTINGS, epochs=1, seed=seed))
        weights.append((tmp_path / name / "model.safetensors").read_bytes())
    assert weights[0] == weights[1] != weights[2]


@pytest.mark.heavy
def test_training_finds_the_dot(tmp_path: Path) -> None:
    examples = dots(150)
    settings = replace(SETTINGS, epochs=12, learning_rate=3e-3)
    training, network = trained(examples, tmp_path / "run", settings)
    losses = [epoch["loss"] for epoch in training.history]
    assert losses[-1] < losses[0] / 5
    images: NDArray[np.uint8] = np.concatenate(list(examples.pixels))
    found = decode(*Model(network, "locanet").grids(images))
    best = (found.v_px[:, 0] // 8 * 6 + found.u_px[:, 0] // 8).astype(int)
    right = best == examples.robots[:, 0, 1] // 8 * 6 + examples.robots[:, 0, 0] // 8
    assert right.mean() > 0.95
    np.testing.assert_allclose(found.depth_m[right, 0], 1.5, atol=0.3)


@pytest.mark.slow
def test_dmrl_nano_finds_the_dot_within_its_cell(tmp_path: Path) -> None:
    examples = dots(64)
    settings = FitSettings(
        epochs=20, batch_size=8, ema_steps=40, rotation_deg=0.0, blur_share=0.0, device="cpu"
    )
    _, network = trained(examples, tmp_path / "run", settings)
    scored = scores(network, examples)
    assert np.median(scored.label_error.norm_px) < 1.0
    assert np.nanmean(np.abs(scored.label_error.depth_m)) < 0.15
    threshold = best_threshold(scored)
    assert threshold is not None
    assert 0.05 < threshold < 0.95


@pytest.mark.heavy
def test_the_kept_weights_are_the_mean_of_those_of_many_steps(tmp_path: Path) -> None:
    examples, settings = dots(12), replace(EVERYTHING, epochs=2)
    _, last = trained(examples, tmp_path / "last", replace(settings, ema_steps=0))
    _, mean = trained(examples, tmp_path / "mean", settings)
    _, one = trained(examples, tmp_path / "one", replace(settings, ema_steps=1))
    for a, b, c in zip(last.parameters(), mean.parameters(), one.parameters(), strict=True):
        assert not torch.equal(a, b)
        assert torch.isfinite(b).all()
        torch.testing.assert_close(a.detach(), c, rtol=0.2, atol=0.05)


def test_the_last_epochs_keep_images_whole() -> None:
    settings = FitSettings(epochs=10, plain_epochs=3, paste=1.0)
    assert settings.augmentation(6) == replace(settings, plain_epochs=0).augmentation(9)
    plain = settings.augmentation(7)
    assert (plain.mosaic_share, plain.paste, plain.rotation_deg) == (0, 0, 0)
    assert plain.zoom == (1.0, 1.0)
    assert (plain.flip_share, plain.colour) == (settings.flip_share, settings.colour)


@pytest.mark.parametrize("frozen", [0, 1])
def test_frozen_norms_are_learnt_but_not_measured(
    examples: Examples, tmp_path: Path, frozen: int
) -> None:
    settings = replace(SETTINGS, epochs=2, frozen_norm_epochs=frozen)
    training = Training(new_network(settings, examples), examples, settings, tmp_path)
    seen: list[dict[str, torch.Tensor]] = []
    for number, _ in enumerate(training.steps(), start=1):
        if number % 7 == 0:  # the end of an epoch: 20 images by threes
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


def test_a_teacher_that_says_the_same_leaves_nothing_to_learn(examples: Examples) -> None:
    settings = FitSettings(distill_share=1.0, device="cpu")
    batch = gathered(examples, np.arange(8))
    student = build("dmrl-nano", seed=1).eval()
    teacher = build("dmrl-large", seed=2).eval()
    for network in (student, teacher):
        with torch.no_grad():
            network.head.bias[1] = 1.0  # type: ignore[union-attr, index, operator]
    itself = losses(student, batch, settings, student)
    other = losses(student, batch, settings, teacher)
    assert itself.tolist() == pytest.approx([0.0] * 5, abs=1e-6)
    assert (other[:3] > 1e-3).all()
    half = losses(student, batch, replace(settings, distill_share=0.5), teacher)
    labels = losses(student, batch, settings)
    torch.testing.assert_close(half, (other + labels) / 2)


@pytest.mark.slow
def test_classes_and_the_spread_are_learnt(examples: Examples, tmp_path: Path) -> None:
    # Squares of class 1 are grey: that is what tells them apart.
    pixels: NDArray[np.uint8] = np.concatenate(list(dots(64).pixels))
    robots = dots(64).robots
    grey = robots[:, 0, CLASS_ID] == 1
    pixels[grey] = np.minimum(pixels[grey], 120)
    settings = FitSettings(
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
    _, network = trained(Examples([pixels], robots), tmp_path / "run", settings)
    found = decode(*Model(network, "dmrl-nano").grids(pixels))
    assert (found.class_id[:, 0] == grey).mean() > 0.9
    error_m = np.abs(found.depth_m[:, 0] - 1.5)
    assert 0.2 < np.median(error_m) / np.median(found.sigma_depth_m[:, 0]) < 2


def test_another_training_is_not_resumed(examples: Examples, tmp_path: Path) -> None:
    stopped(examples, tmp_path / "run", 1, 1)
    text = r"was trained with learning_rate 0\.001, not 0\.01\. Resume with the settings"
    with pytest.raises(SettingError, match=text):
        trained(examples, tmp_path / "run", replace(SETTINGS, learning_rate=0.01), resume=True)


def test_without_a_checkpoint_there_is_nothing_to_resume(
    examples: Examples, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match=r"no checkpoint in .* Train without --resume"):
        trained(examples, tmp_path / "run", resume=True)


def test_a_damaged_checkpoint_is_one_line(examples: Examples, tmp_path: Path) -> None:
    stopped(examples, tmp_path / "run", 1, 1)
    (tensors,) = (tmp_path / "run").glob("checkpoint-*.safetensors")
    tensors.write_bytes(tensors.read_bytes()[:-9])
    with pytest.raises(ModelError, match=r"checkpoint\.json is damaged"):
        trained(examples, tmp_path / "run", resume=True)


def test_one_checkpoint_is_kept_and_none_after_the_end(examples: Examples, tmp_path: Path) -> None:
    stopped(examples, tmp_path / "run", 3, 1)
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {"checkpoint.json", "checkpoint-0003.safetensors", "tensorboard"}
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["epochs_done"] == 3
    trained(examples, tmp_path / "run", resume=True)
    assert not has_checkpoint(tmp_path / "run")


def test_a_loss_that_is_no_number_stops_the_training(examples: Examples, tmp_path: Path) -> None:
    wild = replace(SETTINGS, learning_rate=1e30, warmup_epochs=0)
    with pytest.raises(SettingError, match=r"the loss is nan in epoch 1, step 7\. Lower"):
        trained(examples, tmp_path / "run", wild)


def test_tensorboard_gets_loss_and_learning_rate(examples: Examples, tmp_path: Path) -> None:
    trained(examples, tmp_path / "run")
    log = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    log.Reload()
    assert set(log.Tags()["scalars"]) == {"loss/train", "learning_rate"}
    assert [event.step for event in log.Scalars("loss/train")] == [7, 14, 21, 28]


def test_validation_is_watched_and_changes_nothing(examples: Examples, tmp_path: Path) -> None:
    weights = []
    for name, watched in (("without", None), ("with", examples)):
        (tmp_path / name).mkdir()
        network = new_network(SETTINGS, examples)
        training = Training(network, examples, SETTINGS, tmp_path / name, validation=watched)
        assert sum(1 for _ in training.steps()) == 28
        assert all(("validation_loss" in epoch) == bool(watched) for epoch in training.history)
        save_model(Model(network, "locanet"), tmp_path / name)
        weights.append((tmp_path / name / "model.safetensors").read_bytes())
    assert weights[0] == weights[1]


def test_the_learning_rate_rises_for_two_epochs_and_falls_to_its_end() -> None:
    rates = [learning_rate_at(step, 100, PUBLISHED) for step in range(1, 1501)]
    assert rates[0] == pytest.approx(1e-3 / 200)
    assert rates[99] == pytest.approx(0.5e-3)
    assert max(rates) == rates[199] == pytest.approx(1e-3)
    assert rates[849] == pytest.approx((1e-3 + 1e-6) / 2)
    assert rates[-1] == pytest.approx(1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("epochs", 0),
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
        replace(FitSettings(), **{name: value})  # type: ignore[arg-type]


def test_images_that_do_not_fit_the_network_are_refused(examples: Examples) -> None:
    odd = Examples([p[:, :30] for p in examples.pixels], examples.robots)
    with pytest.raises(SettingError, match=r"images of 48 x 30 px do not fit locanet"):
        new_network(SETTINGS, odd)
    none = Examples([p[:0] for p in examples.pixels], examples.robots[:0])
    with pytest.raises(SettingError, match="no images to train on"):
        new_network(SETTINGS, none)


def test_a_missing_cuda_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert device_of("auto").type == "cpu"
    with pytest.raises(SettingError, match="no CUDA device here"):
        device_of("cuda")


def test_a_mean_of_weights_follows_the_first_steps_and_forgets_slowly_later() -> None:
    network = build("dmrl-nano")
    mean = Average(network, 100)
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


def test_a_teacher_s_share_of_the_loss_is_the_one_that_is_asked_for(examples: Examples) -> None:
    settings = replace(SETTINGS, architecture="dmrl-nano")
    pupil, teacher = (build("dmrl-nano", seed=seed).eval() for seed in (1, 2))
    batch = gathered(examples, [0, 1])
    with torch.no_grad():
        alone = losses(pupil, batch, settings)
        none, half, all_ = (
            losses(pupil, batch, replace(settings, distill_share=share), teacher)
            for share in (0.0, 0.25, 1.0)
        )
    torch.testing.assert_close(none, alone)
    assert not torch.allclose(all_, alone)
    torch.testing.assert_close(half, 0.75 * none + 0.25 * all_)


def test_gradients_of_one_step_are_gone_before_the_next(examples: Examples) -> None:
    network = build("locanet").train()
    optimizer = torch.optim.SGD(network.parameters(), lr=0.0)
    batch = gathered(examples, [0, 1])
    sizes = []
    for _ in range(2):
        train_step(network, optimizer, batch, SETTINGS, 0.0)
        sizes.append([float(p.grad.norm()) for p in network.parameters() if p.grad is not None])
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-3)


def test_every_epoch_has_an_order_of_its_own(examples: Examples, tmp_path: Path) -> None:
    training = Training(new_network(SETTINGS, examples), examples, SETTINGS, tmp_path)
    seen = [torch.cat([b.images for b in training._batches(epoch, None)]) for epoch in (0, 0, 1)]
    assert torch.equal(seen[0], seen[1])
    assert not torch.equal(seen[0], seen[2])


def test_an_epoch_of_so_many_images_takes_as_many_steps_of_few(
    examples: Examples, tmp_path: Path
) -> None:
    settings = replace(SETTINGS, epochs=2, epoch_images=3 * SETTINGS.batch_size + 1)
    few = examples.select(np.arange(len(examples)) < 5)
    training = Training(new_network(settings, few), few, settings, tmp_path)
    assert training.steps_left == 8
    sizes = [len(batch.images) for batch in training._batches(0, None)]
    assert sizes == [settings.batch_size] * 3 + [1]
    assert [step.epoch for step in training.steps()] == [1] * 4 + [2] * 4
    assert all(np.isfinite(epoch["loss"]) for epoch in training.history)


def test_the_loss_that_is_shown_is_the_mean_over_the_images_since_the_last(
    examples: Examples, tmp_path: Path
) -> None:
    settings = replace(SETTINGS, epochs=2)
    training = Training(new_network(settings, examples), examples, settings, tmp_path)
    shown = [step.loss for step in training.steps()]
    # Seven batches of an epoch, the last of two images: looked at once, at its end.
    assert [shown[6], shown[13]] == pytest.approx([epoch["loss"] for epoch in training.history])


def test_curves_stand_at_the_steps_of_what_they_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows: list[tuple[str, float, int]] = []

    @contextmanager
    def opened(_: Path, first_step: int) -> Iterator[Callable[..., None]]:
        rows.append(("first", 0.0, first_step))
        yield lambda *row: rows.append(row)

    monkeypatch.setattr(fit.boards, "opened", opened)
    settings, images = replace(SETTINGS, epochs=2), dots(7)  # three steps, the last of one image
    network = new_network(settings, images)
    training = Training(network, images, settings, tmp_path, validation=dots(3))
    assert training.steps_left == 6
    assert [step.epoch for step in training.steps()] == [1, 1, 1, 2, 2, 2]
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


def test_every_step_is_asked_for_as_the_recipe_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is computed here: what each step of three epochs would be given."""
    images, asked = dots(8), []
    settings = replace(SETTINGS, epochs=3, frozen_norm_epochs=1, ema_steps=5, hard_share=0.25)
    teacher = build("dmrl-nano").train()

    def step(network: Network, _: object, batch: Batch, *rest: object) -> torch.Tensor:
        norms = {m.training for m in network.modules() if isinstance(m, torch.nn.BatchNorm2d)}
        asked.append((batch.robots[:, 0, :2].tolist(), network.training, norms, rest))
        return torch.full((len(LOSSES),), float(len(asked)))

    updated, hard = [], []
    monkeypatch.setattr(fit, "train_step", step)
    monkeypatch.setattr(fit, "save_checkpoint", lambda *_: None)
    monkeypatch.setattr(fit.boards, "opened", lambda *_: nullcontext(lambda *_: None))
    monkeypatch.setattr(fit, "mined", lambda *given: hard.append(given))
    monkeypatch.setattr(fit.Average, "update", lambda _, at: updated.append(at))
    shares = np.ones(8)
    training = Training(
        new_network(settings, images), images, settings, tmp_path, teacher=teacher, shares=shares
    )
    shown = [(step.epoch, step.loss) for step in training.steps()]
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
            {"loss": len(LOSSES) * means, **dict.fromkeys(LOSSES, means)}
        )
        assert shown[3 * epoch + 2][1] == pytest.approx(len(LOSSES) * means)
    for number, (*_, (given, rate, group, share, taught)) in enumerate(asked, start=1):
        assert (given, rate) == (settings, learning_rate_at(number, 3, settings))
        assert (group.size, share) == (1, 1.0)  # type: ignore[attr-defined]
        assert taught is teacher and not teacher.training
    assert len(hard) == 3
    for network, examples, before, share in hard:
        assert network is training.network and examples is images
        assert before is shares and share == 0.25


@pytest.mark.parametrize(("width", "height", "fits"), [(48, 32, 1), (44, 32, 0), (48, 28, 0)])
def test_both_sides_of_images_fit_a_network(width: int, height: int, fits: int) -> None:
    robots = np.full((1, 1, len(FIELDS)), np.nan, np.float32)
    images = Examples([np.zeros((1, height, width, 3), np.uint8)], robots)
    if fits:
        assert new_network(SETTINGS, images).stride_px == 8
    else:
        with pytest.raises(SettingError, match=f"images of {width} x {height} px do not fit"):
            new_network(SETTINGS, images)


@pytest.mark.parametrize("warmup", [0, 1, 2])
def test_learning_rates_are_a_line_and_half_a_cosine(warmup: int) -> None:
    settings = replace(
        SETTINGS, epochs=4, warmup_epochs=warmup, learning_rate=0.5, final_learning_rate=0.1
    )
    rates = [learning_rate_at(step, 5, settings) for step in range(1, 21)]
    up, rest = 5 * warmup, 20 - 5 * warmup
    wanted = [0.5 * step / up for step in range(1, up)]
    wanted += [0.1 + 0.2 * (1 + np.cos(np.pi * k / rest)) for k in range(rest + 1)]
    assert rates == pytest.approx(wanted[-20:])


def test_terms_of_the_loss_stand_in_this_order() -> None:
    names = ("confidence", "depth", "offset", "spread", "class")
    assert tuple(f"{name}_loss" for name in names) == LOSSES
