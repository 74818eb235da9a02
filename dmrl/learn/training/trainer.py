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
from dmrl.guards.memory import keep_freed_memory
from dmrl.learn.data import batches
from dmrl.learn.data.augment import Augmenter
from dmrl.learn.data.batches import Batch, ExampleSet
from dmrl.learn.inference.decode_grids import require_whole_cells
from dmrl.learn.networks.architectures import Network, build_network
from dmrl.learn.training import tensorboard_log as boards
from dmrl.learn.training.checkpoint import TrainingProgress, load_checkpoint, save_checkpoint
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.consistency import UnlabelledImages
from dmrl.learn.training.distributed import ProcessGroup
from dmrl.learn.training.hard_negatives import mine_hard_negatives
from dmrl.learn.training.optimizer import build_optimizer
from dmrl.learn.training.train_step import LOSS_NAMES, SINGLE_PROCESS, WeightEma, train_step
from dmrl.learn.training.validation import validate

SampleWeights = NDArray[np.float64] | None
"""(N,) how often each image appears in an epoch, 1 on average; None: once."""
LOG_EVERY_STEPS = 10
"""Steps between two readings of the loss, since each reading synchronises an accelerator."""


class StepProgress(NamedTuple):
    """Progress after a training step: epoch from 1, and the mean loss of the last few steps.

    The loss is None until the epoch has read one.
    """

    epoch: int
    loss: float | None


def select_device(name: str) -> torch.device:
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


def learning_rate_at(step: int, steps_per_epoch: int, settings: TrainConfig) -> float:
    """Return the learning rate of a step (from 1): linear warm-up, then a half cosine."""
    warmup = settings.warmup_epochs * steps_per_epoch
    if step < warmup:
        return settings.learning_rate * step / warmup
    rest = max(settings.epochs * steps_per_epoch - warmup, 1)
    share = (1 + math.cos(math.pi * (step - warmup) / rest)) / 2
    low = settings.final_learning_rate
    return low + (settings.learning_rate - low) * share


def build_initial_network(settings: TrainConfig, examples: ExampleSet) -> Network:
    """Build the network to train, with initial weights from the seed.

    Raises
    ------
    SettingError
        If the architecture does not exist, there are no images, or it does not support their size.
    """
    network = build_network(
        settings.architecture, seed=settings.seed, extra=settings.extra_channels
    )
    if not len(examples):
        raise SettingError("no images to train on. Use a dataset with a train split")
    height_px, width_px, _ = examples.image_shape
    size_px = (width_px, height_px)
    require_whole_cells(size_px, network.stride_px, settings.architecture, "the dataset")
    return network


class Trainer:
    """Training loop: iterate ``train_steps()`` to the end, then use ``history`` and ``network``.

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
    unlabelled
        Images without labels, of which pairs make half a batch for the consistency loss.
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
        examples: ExampleSet,
        settings: TrainConfig,
        folder: Path,
        *,
        validation: ExampleSet | None = None,
        shares: NDArray[np.float64] | None = None,
        identity: str = "",
        teacher: Network | None = None,
        unlabelled: UnlabelledImages | None = None,
        group: ProcessGroup = SINGLE_PROCESS,
        resume: bool = False,
    ) -> None:
        self._group = group
        self._learning = network.to(select_device(settings.device))
        self._unlabelled = unlabelled
        self._teacher = teacher and teacher.to(select_device(settings.device)).eval()
        self._examples, self._validation, self._shares = examples, validation, shares
        self._settings, self._folder = settings, folder
        self._optimizer = build_optimizer(network, settings.optimizer, settings.weight_decay)
        self._average = WeightEma(network, settings.ema_steps) if settings.ema_steps else None
        self._epoch_images = settings.epoch_images or len(examples)
        self._steps_per_epoch = batches.count_batches(self._epoch_images, settings.batch_size)
        run = {**asdict(settings), "data": identity}
        self._state = TrainingProgress(run)
        if resume:
            self._state = load_checkpoint(folder, self._networks_by_role(), self._optimizer, run)

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
        """Number of steps that ``train_steps()`` will take."""
        return (self._settings.epochs - self._state.epochs_done) * self._steps_per_epoch

    def train_steps(self) -> Iterator[StepProgress]:
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
        keep_freed_memory(2**31 - 1)
        with self._open_log(first * self._steps_per_epoch + 1) as board:
            for epoch in range(first, self._settings.epochs):
                left = self._settings.epochs - epoch
                frozen = left <= self._settings.frozen_norm_epochs
                _switch_to_training(self._learning, frozen_norms=frozen)
                said = yield from self._train_epoch(epoch, board)
                self._learning.eval()
                if self._validation is not None and self._group.is_main:
                    said |= validate(self.network, self._validation, self._settings)
                    at = (epoch + 1) * self._steps_per_epoch
                    for name in sorted(said.keys() - {"loss", *LOSS_NAMES}):
                        board(name.replace("_", "/", 1), said[name], at)
                self._state = TrainingProgress(self._state.run, epoch + 1, [*self.history, said])
                if self._group.is_main:
                    networks = self._networks_by_role()
                    save_checkpoint(self._folder, networks, self._optimizer, self._state)

    @contextmanager
    def _open_log(self, first_step: int) -> Iterator[boards.ScalarWriter]:
        """Open the TensorBoard log; only the first process writes one."""
        if not self._group.is_main:
            yield lambda name, value, step: None
            return
        with boards.open_log(self._folder / "tensorboard", first_step) as board:
            yield board

    def _networks_by_role(self) -> dict[str, Network]:
        averaged = {"average": self._average.network} if self._average else {}
        return {"network": self._learning, **averaged}

    def _iter_batches(self, epoch: int, shares: SampleWeights) -> Iterator[Batch]:
        size, seed = self._settings.batch_size, self._settings.seed
        indices = batches.epoch_indices(
            len(self._examples), seed=seed, epoch=epoch, shares=shares, images=self._epoch_images
        )
        augmentation = self._settings.augmentation(epoch)
        augmenter = (
            None if augmentation.is_identity else Augmenter(self._examples, augmentation, seed=seed)
        )
        for index, start in enumerate(range(0, len(indices), size)):
            whole = indices[start : start + size]
            # With more processes than images, the others compute an image of weight 0.
            chosen = self._group.select_part(whole) if len(whole) >= self._group.size else whole[:1]
            if augmenter is None:
                yield batches.collate(self._examples, chosen)
            else:
                yield augmenter.augment_batch(
                    chosen, epoch=epoch, index=index * self._group.size + self._group.rank
                )

    def _train_epoch(
        self, epoch: int, board: boards.ScalarWriter
    ) -> Generator[StepProgress, None, dict[str, float]]:
        """Train one epoch and return its mean losses."""
        size = self._settings.batch_size
        seen: list[Tensor] = []
        loss: float | None = None
        total = torch.zeros(len(LOSS_NAMES))
        shares, hard = self._shares, self._settings.hard_share
        if hard:
            shares = mine_hard_negatives(self.network, self._examples, shares, hard)
        for index, batch in enumerate(batches.prefetch(self._iter_batches(epoch, shares)), start=1):
            step = epoch * self._steps_per_epoch + index
            rate = learning_rate_at(step, self._steps_per_epoch, self._settings)
            whole = min(size, self._epoch_images - (index - 1) * size)
            parts = self._train_batch(batch, rate, whole, step)
            if self._average:
                self._average.update(step)
            seen.append(parts * whole)
            if index % LOG_EVERY_STEPS == 0 or index == self._steps_per_epoch:
                recent = torch.stack(seen).cpu()
                loss = float(recent.sum()) / ((len(seen) - 1) * size + whole)
                _require_finite(loss, epoch + 1, index)
                board("loss/train", loss, step)
                board("learning_rate", rate, step)
                total += recent.sum(dim=0)
                seen.clear()
            yield StepProgress(epoch + 1, loss)
        means = (total / self._epoch_images).tolist()
        return {"loss": sum(means), **dict(zip(LOSS_NAMES, means, strict=True))}

    def _train_batch(self, batch: Batch, rate: float, whole: int, step: int) -> Tensor:
        """Take one step on this process's part of a batch of ``whole`` images; return losses."""
        group, settings = self._group, self._settings
        seed = (settings.seed, step, group.rank)
        pairs = None
        if self._unlabelled is not None:
            pairs = self._unlabelled.draw(settings.batch_size // 4, seed)
        share = len(group.select_part(np.arange(whole))) / whole
        return train_step(
            self._learning,
            self._optimizer,
            batch,
            settings,
            rate,
            group,
            share,
            self._teacher,
            pairs,
        )


def _switch_to_training(network: Network, *, frozen_norms: bool) -> None:
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
