"""Short trainings on small images of one bright square."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from dmrl import recipe
from dmrl.learn.data.batches import ROBOT_FIELDS, ExampleSet
from dmrl.learn.inference.loaded_model import Model, save_model
from dmrl.learn.networks.architectures import Network
from dmrl.learn.training.checkpoint import remove_checkpoint
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.trainer import Trainer, build_initial_network

PUBLISHED = recipe.load("locanet", "train", TrainConfig)
SETTINGS = replace(PUBLISHED, epochs=4, batch_size=3, warmup_epochs=1, device="cpu")
EVERYTHING = TrainConfig(
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


def draw_dots(count: int) -> ExampleSet:
    """Return dark images, 32 x 48 px, of one bright square labelled at its centre, 1.5 m away.

    The images lie in two arrays; labels alternate between classes 0 and 1.
    """
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 40, (count, 32, 48, 3), np.uint8)
    robots = np.zeros((count, 1, len(ROBOT_FIELDS)), np.float32)
    for k, cell in enumerate(rng.integers(0, 24, count)):
        row, col = divmod(int(cell), 6)
        pixels[k, 8 * row + 2 : 8 * row + 6, 8 * col + 2 : 8 * col + 6] = 250
        box = (8 * col + 2, 8 * row + 2, 8 * col + 6, 8 * row + 6)
        robots[k, 0] = (8 * col + 4, 8 * row + 4, 1.5, 0, 0, 0, *box, k % 2)
    return ExampleSet([pixels[:7], pixels[7:]], robots)


def train(
    examples: ExampleSet, folder: Path, settings: TrainConfig = SETTINGS, *, resume: bool = False
) -> tuple[Trainer, Network]:
    """Train to the last epoch and save the model in a folder; return the trainer and network."""
    folder.mkdir(exist_ok=True)
    network = build_initial_network(settings, examples)
    training = Trainer(network, examples, settings, folder, identity="dots", resume=resume)
    for _ in training.train_steps():
        pass
    kept = Model(training.network, settings.architecture, training={"history": training.history})
    save_model(kept, folder)
    remove_checkpoint(folder)
    return training, training.network
