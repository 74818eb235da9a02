"""Training of a network on an Arrow dataset, to a run folder."""

import time
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.compute as pc

from dmrl.atomic_output import atomic_folder, refuse_existing, to_partial_path
from dmrl.datasets import Dataset, Split, open_dataset
from dmrl.datasets.backgrounds import open_backgrounds
from dmrl.errors import ModelError, OutputError, SettingError, optional_imports
from dmrl.geometry.frames import AIDECK_PINHOLE
from dmrl.recording import build_provenance
from dmrl.terminal.progress import track

with optional_imports("train", "dmrl train"):
    from dmrl.datasets.training_examples import TrainingData, load_training_data
    from dmrl.learn.data.batches import ROBOT_FIELDS, ExampleSet
    from dmrl.learn.inference import confidence_calibration, loaded_model
    from dmrl.learn.inference.detector_rates import measure_rates
    from dmrl.learn.inference.threshold import (
        count_false_alarms,
        find_unlabelled_images,
        select_threshold,
    )
    from dmrl.learn.networks.architectures import Network
    from dmrl.learn.training.checkpoint import has_checkpoint, remove_checkpoint
    from dmrl.learn.training.config import AUTO, DEFAULT_ARCHITECTURE, TrainConfig
    from dmrl.learn.training.consistency import UnlabelledImages
    from dmrl.learn.training.distributed import ProcessGroup, run_distributed
    from dmrl.learn.training.trainer import (
        StepProgress,
        Trainer,
        build_initial_network,
        select_device,
    )
    from dmrl.learn.training.validation import score_examples

LIBRARIES = ("torch", "numpy")


@dataclass(frozen=True, slots=True)
class Result:
    """Number of images, mean loss of the last epoch, and time of a training."""

    images: int
    loss: float
    seconds: float
    images_per_s: float


class Given(NamedTuple):
    """What a training is given beside its dataset.

    Parameters
    ----------
    init
        Model whose weights to start from. None: new weights, by the seed.
    teacher
        Model that is learnt from beside the labels. None: the labels alone.
    unlabelled
        Images without labels, for the consistency loss. None: none.
    resume
        Go on with the interrupted training in ``<out>.partial``; from the start, if that had
        not come to the end of its first epoch.
    """

    init: Path | None = None
    teacher: Path | None = None
    unlabelled: UnlabelledImages | None = None
    resume: bool = False

    @property
    def paths(self) -> tuple[Path, ...]:
        """Files and folders of all of them."""
        models = (path for path in (self.init, self.teacher) if path)
        return (*models, *(self.unlabelled.paths if self.unlabelled else ()))


def train_network(dataset: Path, out: Path, settings: TrainConfig, given: Given) -> Result:
    """Train on the train split of a dataset and write the run folder.

    Confidence is calibrated, and the threshold chosen, on images held out: the split named val
    or, where there is none, a share of the train split.

    Parameters
    ----------
    dataset
        Folder of the dataset.
    out
        Run folder to write. Until the training is done it is ``<out>.partial``.
    settings
        See `FitSettings`.
    given
        Models and images beside the dataset, and whether to resume.

    Raises
    ------
    OutputError
        If ``out`` exists, or an interrupted training is in the way.
    DatasetError
        If ``dataset`` is not one, or has no train split.
    ModelError
        If a model cannot be used, or there is nothing to resume.
    SettingError
        If the network cannot take the images, its grid is not the teacher's, or the loss is no
        longer a number.
    """
    if settings.init_share and given.init is None:
        raise SettingError("init_share requires an initial model. Pass --init MODEL")
    if not settings.epochs and given.init is None:
        raise SettingError("epochs: 0 trains nothing. Give --init MODEL to calibrate, or epochs")
    settings = _with_architecture(settings, given.init)
    processes = settings.processes if select_device(settings.device).type == "cpu" else 1
    return run_distributed(processes, partial(_train_in_process, dataset, out, settings, given))


def _with_architecture(settings: TrainConfig, init: Path | None) -> TrainConfig:
    """Return settings that name a network: for "auto", that of ``init`` or the default one."""
    if settings.architecture != AUTO:
        return settings
    return replace(
        settings,
        architecture=loaded_model.load_model(init).architecture if init else DEFAULT_ARCHITECTURE,
    )


def _train_in_process(
    dataset: Path, out: Path, settings: TrainConfig, given: Given, group: ProcessGroup
) -> Result:
    """Train in one process of a group. All compute; the leading one alone writes and prints."""
    if group.is_main:
        refuse_existing(out)
        _refuse_unfinished(to_partial_path(out), resume=given.resume)
    data = open_dataset(dataset)
    train, loaded = data.split("train"), load_training_data(data, settings)
    network = _build_network(settings, loaded.examples, given.init)
    first = {name: value.clone() for name, value in loaded_model.get_weights(network).items()}
    teacher = _load_teacher(given.teacher, network) if given.teacher else None
    inputs = [dataset, *given.paths]
    made = build_provenance("train", settings, inputs, seed=settings.seed, libraries=LIBRARIES)
    mine = atomic_folder(out, keep_on_error=True, resume=given.resume)
    with mine if group.is_main else nullcontext(to_partial_path(out)) as folder:
        training = Trainer(
            network,
            loaded.examples,
            settings,
            folder,
            validation=loaded.held_out,
            shares=loaded.shares,
            identity=" ".join(source.sha256 for source in made.inputs),
            teacher=teacher,
            unlabelled=given.unlabelled,
            group=group,
            resume=given.resume and has_checkpoint(folder),
        )
        if group.is_main:
            made.write(folder)
        result = _run_steps(training, settings, len(loaded.examples), group)
        if group.is_main:
            loaded_model.interpolate_weights(training.network, first, settings.init_share)
            _write_model(training, settings, (data, train), loaded, folder)
            remove_checkpoint(folder)
    return result


def _refuse_unfinished(partial: Path, *, resume: bool) -> None:
    if resume and not partial.is_dir():
        raise ModelError(f"no {partial} to resume. Train without --resume")
    if not resume and has_checkpoint(partial):
        raise OutputError(
            f"{partial} holds an interrupted training. Go on with --resume, or remove it"
        )


EMPTY_IMAGES = 100
"""Rooms without a robot that dmrl draws where the images held out have fewer: of 20, two in a
hundred cannot be told from none."""


class Calibrated(NamedTuple):
    """Threshold, calibration and rates of a network, and how the threshold was chosen."""

    threshold: float
    calibration: confidence_calibration.PlattScaling | None
    rates: dict[str, Any] | None
    promise: dict[str, Any] | None = None


def _calibrate(network: Network, loaded: TrainingData, settings: TrainConfig) -> Calibrated:
    """Calibrate the network on the images held out, and choose its threshold there."""
    held_out = loaded.held_out
    if held_out is None:
        return Calibrated(_or_published(settings.threshold), None, None)
    scored = score_examples(network, held_out)
    found = confidence_calibration.fit_calibration(scored, loaded.sources)
    if found is not None and confidence_calibration.apply_calibration(network, found):
        scored = score_examples(network, held_out)
    else:
        found = None
    rates, source = measure_rates(scored), "the images held out"
    threshold = settings.threshold
    if threshold is None:
        if find_unlabelled_images(scored).sum() < EMPTY_IMAGES:
            source += " and rooms that dmrl draws"
            scored = score_examples(network, _add_empty_rooms(held_out, settings.seed))
        threshold = _or_published(select_threshold(scored, settings.false_alarms))
    counted = count_false_alarms(scored, threshold)
    promise = {
        "a hit is within": "16 px and twice the sigma of its label",
        "false alarms allowed": settings.false_alarms,
        "false alarms an empty image": counted.false_alarms,
        "empty images": counted.empty_images,
        "they are of": source,
    }
    return Calibrated(threshold, found, rates, promise)


def _add_empty_rooms(held_out: ExampleSet, seed: int) -> ExampleSet:
    """Return the images, and rooms without a robot of the same size after them."""
    height_px, width_px, _ = held_out.image_shape
    camera = replace(AIDECK_PINHOLE, width_px=width_px, height_px=height_px)
    rooms, rng = open_backgrounds(Path("rooms")), np.random.default_rng((seed, 7))
    drawn = np.stack([rooms.random_crop(rng, camera, 1.0) for _ in range(EMPTY_IMAGES)])
    nobody = np.full((EMPTY_IMAGES, held_out.robots.shape[1], len(ROBOT_FIELDS)), np.nan, "f4")
    return ExampleSet([*held_out.pixels, drawn], np.concatenate([held_out.robots, nobody]))


def _or_published(threshold: float | None) -> float:
    return loaded_model.PUBLISHED_THRESHOLD if threshold is None else threshold


def _build_network(settings: TrainConfig, examples: ExampleSet, init: Path | None) -> Network:
    network = build_initial_network(settings, examples)
    if init is not None:
        known = loaded_model.load_model(init)
        if known.architecture != settings.architecture:
            raise SettingError(
                f"{init} is a {known.architecture}, not the {settings.architecture} to train. "
                f'Set architecture = "{known.architecture}" in the recipe, or give another --init'
            )
        loaded_model.assign_weights(
            network, loaded_model.transfer_weights(known.network, network), init
        )
    return network


def _load_teacher(path: Path, network: Network) -> Network:
    teacher = loaded_model.load_model(path).network
    if teacher.stride_px != network.stride_px:
        raise SettingError(
            f"{path} has cells of {teacher.stride_px} px, the network to train "
            f"{network.stride_px} px. Give a teacher with the same grid"
        )
    return teacher


def describe_step(step: StepProgress, epochs: int) -> str:
    """Return the words of the progress line, without a loss until the epoch has one."""
    loss = "" if step.loss is None else f", loss {step.loss:.3f}"
    return f"Epoch {step.epoch}/{epochs}{loss}"


def _run_steps(
    training: Trainer, settings: TrainConfig, images: int, group: ProcessGroup
) -> Result:
    def words(step: StepProgress) -> str:
        return describe_step(step, settings.epochs)

    left, begun = training.steps_left, time.perf_counter()
    steps = training.train_steps()
    for _ in track(steps, "Training", left, describe=words) if group.is_main else steps:
        pass
    seconds = time.perf_counter() - begun
    seen = left * min(settings.batch_size, images)
    loss = training.history[-1]["loss"] if training.history else 0.0
    return Result(images, loss, seconds, seen / seconds)


def _write_model(
    training: Trainer,
    settings: TrainConfig,
    trained_on: tuple[Dataset, Split],
    loaded: TrainingData,
    folder: Path,
) -> None:
    """Calibrate the trained network, and write it with what is known of it."""
    data, train = trained_on
    judged = _calibrate(training.network, loaded, settings)
    height_px, width_px = train.image_shape
    peers = pc.list_flatten(train.table.column("peers"))
    sources = pc.unique(pc.struct_field(peers, "source")).to_pylist()
    model = loaded_model.Model(
        training.network,
        settings.architecture,
        width_px=width_px,
        height_px=height_px,
        threshold=judged.threshold,
        label_source=", ".join(sorted(sources)),
        rates=judged.rates,
        focal_px=list(data.focal_px),
        training={
            "images": len(loaded.examples),
            "calibration": judged.calibration and judged.calibration._asdict(),
            "threshold": judged.promise,
            "settings": asdict(settings),
            "history": training.history,
        },
    )
    loaded_model.save_model(model, folder)
