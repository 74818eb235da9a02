"""``dmrl quantize``: a trained network to int8, and the loss of accuracy."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmrl.atomic_output import refuse_existing
from dmrl.errors import optional_imports
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.arguments import Count, Model
from dmrl.terminal.closing import Closing, Given

if TYPE_CHECKING:
    from dmrl.evaluation.quantization_report import QuantizationReport


@dataclass(frozen=True, slots=True)
class Settings:
    """Calibration images, and images that float and int8 are compared on.

    Parameters
    ----------
    images
        Calibration images: so many of the train split, evenly spread.
    grey
        Take grey images, as a monochrome camera gives them: the first layer sums its weights
        over the colours, which is exact where a network was trained on grey images.
    split
        Split to judge float against int8 on. Without it: test, else val, else train.
    most
        Judge on at most this many images, evenly spread.
    """

    images: Count = 200
    grey: bool = False
    split: str | None = None
    most: Count = 1000


def run(model: Model, dataset: Path, out: Path, settings: Settings) -> "QuantizationReport":
    """Quantise a network to int8, and measure the loss of accuracy.

    The output is a run folder as well: the float model lies beside the int8 one.

    Parameters
    ----------
    model
        A run folder of dmrl train, a .safetensors or a Keras .h5.
    dataset
        Dataset with images of the model's size: its train split calibrates, another judges.
    out
        Folder to write: the int8 network, the float one, quantisation.json, a picture of the
        maps. Must not exist.
    settings
        See `Settings`.

    Raises
    ------
    ModelError
        If the model cannot be used, or has a layer that int8 cannot carry.
    DatasetError
        If the dataset cannot be used.
    SettingError
        If its images are of another size, or nothing can be learned from them.
    OutputError
        If ``out`` exists.
    """
    with optional_imports("train", "dmrl quantize"):
        from dmrl.deploy.int8.quantise_model import quantise_model
        from dmrl.evaluation.quantization_report import open_inputs, write_quantized
        from dmrl.learn.pretrained import resolve_model_path
        from dmrl.recording import build_provenance

    refuse_existing(out)
    model = resolve_model_path(model)
    inputs = open_inputs(model, dataset, settings.split)
    made = quantise_model(inputs.model, inputs.calibration, settings.images, grey=settings.grey)
    origin = build_provenance("quantize", settings, (model, dataset), libraries=("torch", "numpy"))
    return write_quantized(out, origin, inputs, made, settings.most)


def _show(report: "QuantizationReport", given: Given) -> None:
    from dmrl.evaluation.quantization_report import print_quantization

    print_quantization(given.out, report)


def _document(report: "QuantizationReport", _: Given) -> dict[str, Any]:
    from dmrl.evaluation.quantization_report import describe_quantization

    return describe_quantization(report)


command = stage_command(run, Closing(show=_show, document=_document))
