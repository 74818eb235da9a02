"""Training: seeded, resumable, watched in TensorBoard."""

import math
from collections.abc import Generator, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from dmrl.errors import SettingError
from dmrl.learn.batches import Batch, Examples, batch_count, shuffled
from dmrl.learn.checkpoint import State, load_checkpoint, save_checkpoint
from dmrl.learn.losses import confidence_loss, depth_loss
from dmrl.learn.network import Network, build, to_input

WATCH_STEPS = 10  # reading a loss makes an accelerator wait, so not at every step
ADAM_EPSILON = 1e-7  # Keras' default, with which the recipe was published


@dataclass(frozen=True, slots=True)
class FitSettings:
    """How a network is trained. The defaults are the published recipe.

    Parameters
    ----------
    architecture
        Name of the network.
    epochs
        Times that every image is seen.
    batch_size
        Images per step.
    learning_rate
        Of Adam, at the end of the warm-up.
    final_learning_rate
        At the last step, after a half cosine.
    warmup_epochs
        Epochs over which the learning rate rises linearly from zero.
    confidence_weight
        Factor of the confidence loss.
    depth_weight
        Factor of the depth loss, 1/m^2.
    threshold
        Confidence from which the model's detections are to be believed, 0 to 1.
    seed
        Of the first weights and the order of the images.
    device
        Where to compute; auto takes CUDA where there is one.
    """

    architecture: str = "locanet"
    epochs: int = 15
    batch_size: int = 5
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-6
    warmup_epochs: int = 2
    confidence_weight: float = 1.0
    depth_weight: float = 1.0
    threshold: float = 0.33
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"

    def __post_init__(self) -> None:
        for name in ("epochs", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1")
        if self.learning_rate <= 0 or not 0 <= self.final_learning_rate <= self.learning_rate:
            raise ValueError("learning_rate: must be over 0 and not below final_learning_rate")
        for name in ("warmup_epochs", "confidence_weight", "depth_weight", "seed"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: must not be negative")
        if not 0 <= self.threshold <= 1:
            raise ValueError("threshold: must be between 0 and 1")


class Step(NamedTuple):
    """One step of a training: epoch from 1, and the mean loss of the last few steps."""

    epoch: int
    loss: float


def device_of(name: str) -> torch.device:
    """The device to compute on.

    Raises
    ------
    SettingError
        If CUDA is asked for and there is none.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise SettingError("no CUDA device here. Use --device cpu")
    return torch.device(name)


def learning_rate_at(step: int, steps_per_epoch: int, settings: FitSettings) -> float:
    """Learning rate of a step (from 1): linear warm-up, then a half cosine."""
    warmup = settings.warmup_epochs * steps_per_epoch
    if step < warmup:
        return settings.learning_rate * step / warmup
    rest = max(settings.epochs * steps_per_epoch - warmup, 1)
    share = (1 + math.cos(math.pi * (step - warmup) / rest)) / 2
    low = settings.final_learning_rate
    return low + (settings.learning_rate - low) * share


def losses(network: Network, batch: Batch, settings: FitSettings) -> Tensor:
    """(2,) weighted confidence and depth loss of a batch."""
    device = next(network.parameters()).device
    images, confidence, depth_m = (t.to(device, non_blocking=True) for t in batch)
    out = network(to_input(images))
    return torch.stack(
        (
            settings.confidence_weight * confidence_loss(out[:, 1], confidence),
            settings.depth_weight * depth_loss(out[:, 0], depth_m, confidence),
        )
    )


def train_step(
    network: Network,
    optimizer: torch.optim.Optimizer,
    batch: Batch,
    settings: FitSettings,
    learning_rate: float,
) -> Tensor:
    """(2,) losses of a batch, after one step of the optimizer on their sum."""
    for group in optimizer.param_groups:
        group["lr"] = learning_rate
    parts = losses(network, batch, settings)
    optimizer.zero_grad(set_to_none=True)
    parts.sum().backward()  # type: ignore[no-untyped-call]
    optimizer.step()
    return parts.detach()


def new_network(settings: FitSettings, examples: Examples) -> Network:
    """The network to train, its first weights drawn with the seed.

    Raises
    ------
    SettingError
        If there is no such architecture, no image, or the network cannot take their size.
    """
    network = build(settings.architecture, seed=settings.seed)
    if not len(examples):
        raise SettingError("no images to train on. Give a dataset with a train split")
    height_px, width_px, _ = examples.image_shape
    cell = network.stride_px
    grid = (height_px // cell, width_px // cell)
    if height_px % cell or width_px % cell or examples.confidence.shape[1:] != grid:
        raise SettingError(
            f"images of {width_px} x {height_px} px with labels on {examples.confidence.shape[1:]} "
            f"cells do not fit {settings.architecture}, whose cells are {cell} px. "
            "Make the dataset from images of another size"
        )
    return network


class Training:
    """One training: iterate ``steps()`` to the end, then look at ``history``.

    Parameters
    ----------
    network
        Trained in place, on the device of the settings.
    examples
        Training images and labels.
    settings
        The recipe.
    folder
        Gets a checkpoint after every epoch, and TensorBoard's log.
    validation
        Images whose loss is logged after every epoch, and used for nothing else.
    identity
        Names the data, so that a training is resumed on the same.
    resume
        Go on from the checkpoint in ``folder``.

    Raises
    ------
    SettingError
        If the checkpoint is of another training, or the device is not there.
    ModelError
        If there is no checkpoint to resume from.
    """

    def __init__(
        self,
        network: Network,
        examples: Examples,
        settings: FitSettings,
        folder: Path,
        *,
        validation: Examples | None = None,
        identity: str = "",
        resume: bool = False,
    ) -> None:
        self._network = network.to(device_of(settings.device))
        self._examples, self._validation = examples, validation
        self._settings, self._folder = settings, folder
        self._optimizer = torch.optim.Adam(network.parameters(), eps=ADAM_EPSILON)
        self._steps_per_epoch = batch_count(len(examples), settings.batch_size)
        run = {**asdict(settings), "data": identity}
        self._state = State(run)
        if resume:
            self._state = load_checkpoint(folder, network, self._optimizer, run)

    @property
    def history(self) -> list[dict[str, float]]:
        """Mean losses of every epoch so far."""
        return self._state.history

    @property
    def steps_left(self) -> int:
        """Steps that ``steps()`` will take."""
        return (self._settings.epochs - self._state.epochs_done) * self._steps_per_epoch

    def steps(self) -> Iterator[Step]:
        """Train, one step at a time.

        Yields
        ------
        Step
            After every step.

        Raises
        ------
        SettingError
            If the loss is no longer a number.
        """
        first = self._state.epochs_done
        log = self._folder / "tensorboard"
        with SummaryWriter(log, purge_step=first * self._steps_per_epoch + 1) as board:
            for epoch in range(first, self._settings.epochs):
                self._network.train()
                mean = yield from self._epoch(epoch, board)
                if self._validation is not None:
                    mean["validation_loss"] = self._validation_loss(self._validation)
                    step = (epoch + 1) * self._steps_per_epoch
                    board.add_scalar("loss/validation", mean["validation_loss"], step)
                self._state = State(self._state.run, epoch + 1, [*self.history, mean])
                save_checkpoint(self._folder, self._network, self._optimizer, self._state)
        self._network.eval()

    def _epoch(self, epoch: int, board: SummaryWriter) -> Generator[Step, None, dict[str, float]]:
        """Train one epoch; returns its mean losses."""
        size, seed = self._settings.batch_size, self._settings.seed
        seen: list[Tensor] = []
        total, loss = torch.zeros(2), math.nan
        batches = shuffled(self._examples, size, seed=seed, epoch=epoch)
        for index, batch in enumerate(batches, start=1):
            step = epoch * self._steps_per_epoch + index
            rate = learning_rate_at(step, self._steps_per_epoch, self._settings)
            parts = train_step(self._network, self._optimizer, batch, self._settings, rate)
            seen.append(parts * len(batch.images))
            if index % WATCH_STEPS == 0 or index == self._steps_per_epoch:
                recent = torch.stack(seen).cpu()
                loss = float(recent.sum()) / ((len(seen) - 1) * size + len(batch.images))
                _require_finite(loss, epoch + 1, index)
                board.add_scalar("loss/train", loss, step)
                board.add_scalar("learning_rate", rate, step)
                total += recent.sum(dim=0)
                seen.clear()
            yield Step(epoch + 1, loss)
        confidence, depth = (total / len(self._examples)).tolist()
        return {"loss": confidence + depth, "confidence_loss": confidence, "depth_loss": depth}

    def _validation_loss(self, examples: Examples) -> float:
        self._network.eval()
        total = 0.0
        with torch.inference_mode():
            for batch in shuffled(examples, self._settings.batch_size, seed=0, epoch=0):
                parts = losses(self._network, batch, self._settings)
                total += float(parts.sum()) * len(batch.images)
        return total / len(examples)


def _require_finite(loss: float, epoch: int, step: int) -> None:
    if not math.isfinite(loss):
        raise SettingError(
            f"the loss is {loss} in epoch {epoch}, step {step}. "
            "Lower --learning-rate, or look for labels that are not finite"
        )
