"""``dmrl train``: an Arrow dataset to a run folder with a trained network."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from dmrl.atomic_output import to_partial_path
from dmrl.guards.lazy_names import import_lazily
from dmrl.terminal.arguments import AsJson, Flat, Model, Recipe
from dmrl.terminal.closing import Closing, Given
from dmrl.terminal.progress import announce_import, say

TRAINING = "dmrl.labelling.unlabelled_training"
__getattr__ = import_lazily(
    __name__, {"run": f"{TRAINING}:train_with_flights", "Settings": f"{TRAINING}:TrainConfig"}
)


@dataclass(frozen=True, slots=True)
class Flags:
    """Settings of the recipe that a flag overrules.

    Parameters
    ----------
    epochs
        Passes over all images. Without it, the recipe's.
    batch_size
        Images per step. Without it, the recipe's.
    learning_rate
        Peak learning rate, at the end of the warm-up. Without it, the recipe's.
    false_alarms
        Largest expected number of detections above the threshold in an image without a robot.
        Without it, the recipe's.
    seed
        Seed of the initial weights and the order of the images. Without it, the recipe's.
    device
        Where to compute. Without it, the recipe's.
    processes
        Training processes that share every batch, on a CPU. Without it, the recipe's.
    """

    epochs: int | None = None
    batch_size: int | None = None
    learning_rate: float | None = None
    false_alarms: float | None = None
    seed: int | None = None
    device: Literal["auto", "cpu", "cuda"] | None = None
    processes: int | None = None


NO_FLAGS = Flags()


def command(
    dataset: Path,
    out: Annotated[Path, Parameter(name="OUT_DIR")],
    /,
    *,
    recipe: Recipe = "dmrl_nano",
    init: Model | None = None,
    teacher: Model | None = None,
    unlabelled: Annotated[tuple[Path, ...], Parameter(negative=(), show_default=False)] = (),
    resume: bool = False,
    flags: Flat[Flags] = NO_FLAGS,
    as_json: AsJson = False,
) -> None:
    """Train a network on a dataset.

    Parameters
    ----------
    dataset
        Folder that dmrl dataset wrote; its train split is used.
    out
        Run folder to write: model.safetensors, model.json, TensorBoard's log.
    recipe
        Every setting: a TOML file, or the name of a shipped recipe. Flags win over it.
    init
        Model to start from: a run folder, a .safetensors or a Keras .h5.
    teacher
        Model to learn from beside the labels, by the recipe's distill_share; as a rule a larger
        one, such as dmrl-large, trained on the same dataset.
    unlabelled
        Recording of a flight with detections. Its images must agree with odometry, and those of two
        robots with each other; see consistency_weight. Repeat for more.
    resume
        Go on with the interrupted training in OUT_DIR.partial.
    """
    announce_import("torch")
    from dmrl import recipe as recipes
    from dmrl.labelling.unlabelled_training import train_with_flights
    from dmrl.learn.training.config import TrainConfig

    settings = recipes.load(recipe, "train", TrainConfig, flags)
    with _suggest_resume(out):
        result = train_with_flights(
            dataset, out, settings, init=init, teacher=teacher, unlabelled=unlabelled, resume=resume
        )
    row = (result.images, settings.epochs, result.loss, result.seconds, result.images_per_s)
    columns = ("images", "epochs", "last loss", "seconds", "images/s")
    closing = Closing(columns=columns, rows=lambda *_: [row], path_key="model")
    closing.print(result, Given(out=out), as_json=as_json)


@contextmanager
def _suggest_resume(out: Path) -> Iterator[None]:
    """Say how to go on if the block is interrupted after a checkpoint."""
    try:
        yield
    except KeyboardInterrupt:
        from dmrl.learn.training.checkpoint import has_checkpoint

        if has_checkpoint(partial := to_partial_path(out)):
            say(f"{partial} holds the epochs done. Go on with the same command and --resume")
        raise
