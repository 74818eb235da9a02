"""Trainer: the training loop, seeded, resumable and logged to TensorBoard."""

import math
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dmrl.errors import SettingError
from dmrl.learn.data.augment import Augmenter
from dmrl.learn.data.batches import Batch, Examples, ahead, batch_count, gathered, order
from dmrl.learn.networks.architectures import Network, build
from dmrl.learn.training import tensorboard_log as boards
from dmrl.learn.training.checkpoint import State, load_checkpoint, save_checkpoint
from dmrl.learn.training.config import FitSettings
from dmrl.learn.training.distributed import Group
from dmrl.learn.training.hard_negatives import mined
from dmrl.learn.training.optimizer import new_optimizer
from dmrl.learn.training.train_step import ALONE, LOSSES, Average, train_step
from dmrl.learn.training.validation import validation_figures

Shares = NDArray[np.float64] | None
"""(N,) how often each image appears in an epoch, 1 on average; None: once."""
WATCH_STEPS = 10
"""Steps between two readings of the loss, since each reading synchronises an accelerator."""


class Step(NamedTuple):
    """Progress after a training step: epoch from 1, and the mean loss of the last few steps."""

    epoch: int
    loss: float


def device_of(name: str) -> torch.device:
    """Select the compute device.

    Raises
    ------
    SettingError
        If CUDA is requested but not available.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise SettingError("no CUDA device here. Use --device cpu")
    return torch.device(name)


def learning_rate_at(step: int, steps_per_epoch: int, settings: FitSettings) -> float:
    """Return the learning rate of a step (from 1): linear warm-up, then a half cosine."""
    warmup = settings.warmup_epochs * steps_per_epoch
    if step < warmup:
        return settings.learning_rate * step / warmup
    rest = max(settings.epochs * steps_per_epoch - warmup, 1)
    share = (1 + math.cos(math.pi * (step - warmup) / rest)) / 2
    low = settings.final_learning_rate
    return low + (settings.learning_rate - low) * share


def new_network(settings: FitSettings, examples: Examples) -> Network:
    """Build the network to train, with initial weights from the seed.

    Raises
    ------
    SettingError
        If the architecture does not exist, there are no images, or it does not support their size.
    """
    network = build(settings.architecture, seed=settings.seed, extra=settings.extra)
    if not len(examples):
        raise SettingError("no images to train on. Use a dataset with a train split")
    height_px, width_px, _ = examples.image_shape
    cell = network.stride_px
    if height_px % cell or width_px % cell:
        raise SettingError(
            f"images of {width_px} x {height_px} px do not fit {settings.architecture}, whose "
            f"cells are {cell} px. Make the dataset from images of another size"
        )
    return network


class Training:
    """Training loop: iterate ``steps()`` to the end, then use ``history`` and ``network``.

    Parameters
    ----------
    network
        Network, trained in place on the configured device.
    examples
        Training images and labels.
    settings
        Training configuration.
    folder
        Folder of the checkpoint, written after every epoch, and of the TensorBoard log.
    validation
        Images evaluated after every epoch and never trained on.
    shares
        (N,) how often each image shall appear in an epoch. None: once.
    identity
        Identity of the data; a training is resumed only on the same data.
    teacher
        Network whose output is learned in addition to the labels. None: labels only.
    group
        Processes that train this network together; only the first writes to ``folder``.
    resume
        Resume from the checkpoint in ``folder``.

    Raises
    ------
    SettingError
        If the checkpoint belongs to another training, or the device is not available.
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
        shares: NDArray[np.float64] | None = None,
        identity: str = "",
        teacher: Network | None = None,
        group: Group = ALONE,
        resume: bool = False,
    ) -> None:
        self._group = group
        self._learning = network.to(device_of(settings.device))
        self._teacher = teacher and teacher.to(device_of(settings.device)).eval()
        self._examples, self._validation, self._shares = examples, validation, shares
        self._settings, self._folder = settings, folder
        self._optimizer = new_optimizer(network, settings.optimizer, settings.weight_decay)
        self._average = Average(network, settings.ema_steps) if settings.ema_steps else None
        self._epoch_images = settings.epoch_images or len(examples)
        self._steps_per_epoch = batch_count(self._epoch_images, settings.batch_size)
        run = {**asdict(settings), "data": identity}
        self._state = State(run)
        if resume:
            self._state = load_checkpoint(folder, self._networks(), self._optimizer, run)

    @property
    def network(self) -> Network:
        """Network to save: the EMA if there is one, else the trained network."""
        return self._average.network if self._average else self._learning

    @property
    def history(self) -> list[dict[str, float]]:
        """Mean losses of every epoch so far, and metrics of the validation images."""
        return self._state.history

    @property
    def steps_left(self) -> int:
        """Number of steps that ``steps()`` will take."""
        return (self._settings.epochs - self._state.epochs_done) * self._steps_per_epoch

    def steps(self) -> Iterator[Step]:
        """Train, one step at a time.

        Yields
        ------
        Step
            Progress after every step.

        Raises
        ------
        SettingError
            If the loss is not finite.
        """
        first = self._state.epochs_done
        with self._board(first * self._steps_per_epoch + 1) as board:
            for epoch in range(first, self._settings.epochs):
                left = self._settings.epochs - epoch
                frozen = left <= self._settings.frozen_norm_epochs
                _for_training(self._learning, frozen_norms=frozen)
                said = yield from self._epoch(epoch, board)
                self._learning.eval()
                if self._validation is not None and self._group.leads:
                    said |= validation_figures(self.network, self._validation, self._settings)
                    at = (epoch + 1) * self._steps_per_epoch
                    for name in sorted(said.keys() - {"loss", *LOSSES}):
                        board(name.replace("_", "/", 1), said[name], at)
                self._state = State(self._state.run, epoch + 1, [*self.history, said])
                if self._group.leads:
                    save_checkpoint(self._folder, self._networks(), self._optimizer, self._state)

    @contextmanager
    def _board(self, first_step: int) -> Iterator[boards.Board]:
        """Open the TensorBoard log; only the first process writes one."""
        if not self._group.leads:
            yield lambda name, value, step: None
            return
        with boards.opened(self._folder / "tensorboard", first_step) as board:
            yield board

    def _networks(self) -> dict[str, Network]:
        averaged = {"average": self._average.network} if self._average else {}
        return {"network": self._learning, **averaged}

    def _batches(self, epoch: int, shares: Shares) -> Iterator[Batch]:
        size, seed = self._settings.batch_size, self._settings.seed
        indices = order(
            len(self._examples), seed=seed, epoch=epoch, shares=shares, images=self._epoch_images
        )
        augmentation = self._settings.augmentation(epoch)
        augmenter = (
            None if augmentation.is_nothing else Augmenter(self._examples, augmentation, seed=seed)
        )
        for index, start in enumerate(range(0, len(indices), size)):
            whole = indices[start : start + size]
            # With more processes than images, the others compute an image of weight 0.
            chosen = self._group.part(whole) if len(whole) >= self._group.size else whole[:1]
            if augmenter is None:
                yield gathered(self._examples, chosen)
            else:
                yield augmenter.batch(
                    chosen, epoch=epoch, index=index * self._group.size + self._group.rank
                )

    def _epoch_shares(self) -> Shares:
        """Return how often each image appears in the next epoch, with hard negatives if enabled."""
        share = self._settings.hard_share
        return mined(self.network, self._examples, self._shares, share) if share else self._shares

    def _epoch(self, epoch: int, board: boards.Board) -> Generator[Step, None, dict[str, float]]:
        """Train one epoch and return its mean losses."""
        size = self._settings.batch_size
        seen: list[Tensor] = []
        total, loss = torch.zeros(len(LOSSES)), math.nan
        shares = self._epoch_shares()
        for index, batch in enumerate(ahead(self._batches(epoch, shares)), start=1):
            step = epoch * self._steps_per_epoch + index
            rate = learning_rate_at(step, self._steps_per_epoch, self._settings)
            whole = min(size, self._epoch_images - (index - 1) * size)
            parts = self._step(batch, rate, whole)
            if self._average:
                self._average.update(step)
            seen.append(parts * whole)
            if index % WATCH_STEPS == 0 or index == self._steps_per_epoch:
                recent = torch.stack(seen).cpu()
                loss = float(recent.sum()) / ((len(seen) - 1) * size + whole)
                _require_finite(loss, epoch + 1, index)
                board("loss/train", loss, step)
                board("learning_rate", rate, step)
                total += recent.sum(dim=0)
                seen.clear()
            yield Step(epoch + 1, loss)
        means = (total / self._epoch_images).tolist()
        return {"loss": sum(means), **dict(zip(LOSSES, means, strict=True))}

    def _step(self, batch: Batch, rate: float, whole: int) -> Tensor:
        """Take one step on this process's part of a batch of ``whole`` images; return losses."""
        group = self._group
        share = len(group.part(np.arange(whole))) / whole
        return train_step(
            self._learning,
            self._optimizer,
            batch,
            self._settings,
            rate,
            group,
            share,
            self._teacher,
        )


def _for_training(network: Network, *, frozen_norms: bool) -> None:
    """Set train mode; with frozen norms, batch normalisation keeps its running statistics."""
    network.train()
    if frozen_norms:
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()


def _require_finite(loss: float, epoch: int, step: int) -> None:
    """Raise SettingError unless the loss is finite."""
    if not math.isfinite(loss):
        raise SettingError(
            f"the loss is {loss} in epoch {epoch}, step {step}. "
            "Lower --learning-rate, or fix labels that are not finite"
        )
