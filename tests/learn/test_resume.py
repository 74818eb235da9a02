"""Interrupted trainings: they resume to the same bytes, or are refused in one line."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from dmrl.errors import ModelError, SettingError
from dmrl.learn.data.batches import ExampleSet
from dmrl.learn.training.checkpoint import has_checkpoint
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.trainer import Trainer, build_initial_network

from .fitting import EVERYTHING, SETTINGS, draw_dots, train

pytestmark = pytest.mark.heavy


def train_interrupted(
    examples: ExampleSet, folder: Path, epochs: int, steps: int, settings: TrainConfig = SETTINGS
) -> None:
    """Train for some epochs and some more steps, then stop without saving a model."""
    folder.mkdir()
    network = build_initial_network(settings, examples)
    training = Trainer(network, examples, settings, folder, identity="dots")
    walk = training.train_steps()
    for _ in range(epochs * -(-len(examples) // settings.batch_size) + steps):
        next(walk)
    walk.close()  # type: ignore[attr-defined]


@pytest.fixture(scope="module", params=[SETTINGS, EVERYTHING], ids=["published", "everything"])
def uninterrupted(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[TrainConfig, Path]:
    """Train without interruption; return the settings and the folder of the model."""
    folder = tmp_path_factory.mktemp("whole")
    train(draw_dots(9), folder, request.param)
    return request.param, folder


@pytest.mark.parametrize("steps", [1, 3])
def test_a_resumed_training_ends_with_the_same_bytes(
    tmp_path: Path, steps: int, uninterrupted: tuple[TrainConfig, Path]
) -> None:
    settings, folder = uninterrupted
    train_interrupted(draw_dots(9), tmp_path / "resumed", 2, steps, settings)
    train(draw_dots(9), tmp_path / "resumed", settings, resume=True)
    for name in ("model.safetensors", "model.json"):
        assert (folder / name).read_bytes() == (tmp_path / "resumed" / name).read_bytes()


def test_another_training_is_not_resumed(examples: ExampleSet, tmp_path: Path) -> None:
    train_interrupted(examples, tmp_path / "run", 1, 1)
    text = r"was trained with learning_rate 0\.001, not 0\.01\. Resume with the settings"
    with pytest.raises(SettingError, match=text):
        train(examples, tmp_path / "run", replace(SETTINGS, learning_rate=0.01), resume=True)


def test_without_a_checkpoint_there_is_nothing_to_resume(
    examples: ExampleSet, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match=r"no checkpoint in .* Train without --resume"):
        train(examples, tmp_path / "run", resume=True)


def test_damaged_checkpoint_gives_one_line_error(examples: ExampleSet, tmp_path: Path) -> None:
    train_interrupted(examples, tmp_path / "run", 1, 1)
    (tensors,) = (tmp_path / "run").glob("checkpoint-*.safetensors")
    tensors.write_bytes(tensors.read_bytes()[:-9])
    with pytest.raises(ModelError, match=r"checkpoint\.json is damaged"):
        train(examples, tmp_path / "run", resume=True)


def test_one_checkpoint_is_kept_until_training_ends(examples: ExampleSet, tmp_path: Path) -> None:
    train_interrupted(examples, tmp_path / "run", 3, 1)
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {"checkpoint.json", "checkpoint-0003.safetensors", "tensorboard"}
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["epochs_done"] == 3
    train(examples, tmp_path / "run", resume=True)
    assert not has_checkpoint(tmp_path / "run")
