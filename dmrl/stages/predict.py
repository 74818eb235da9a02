"""``dmrl predict``: a model and a recording to a recording with detections."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter, validators

from dmrl.deploy.backend_names import BackendName
from dmrl.errors import SettingError
from dmrl.learn.inference.tta_views import TTA_VIEWS
from dmrl.pipeline.stage_command import stage_command
from dmrl.terminal.arguments import Count, In, Model, Share, Strict
from dmrl.terminal.closing import Closing
from dmrl.terminal.progress import say

if TYPE_CHECKING:
    from dmrl.deploy.detector import Detector
    from dmrl.recording import Provenance


@dataclass(frozen=True, slots=True)
class Settings:
    """Backend, limits on the detections, and views of each image.

    Parameters
    ----------
    backend
        Backend. torch and onnx are float; onnx-int8, integer (NumPy), c and riscv32 (the C
        in an emulator, seconds an image) are int8, and need a quantised model or an export
        folder. Without it, onnx where it is installed and supports all outputs of the network,
        else torch.
    threshold
        Confidence threshold, 0 to 1, stored with the detections. Without it, the model's.
    min_confidence
        Leave out detections below this, 0 to 1; the best of each image stays.
    most
        Keep at most this many detections per image.
    views
        Look at every image so many times, 1 to 12, mirrored and shifted by parts of a cell, and
        take the medians. For dmrl label --detections: errors a quarter smaller, and so many times
        the work. Maps are of the first.
    magnify
        See only the middle of every second image of a camera, 3/2 times as large, as the pilots of
        dmrl fly do.
    batch_size
        Images that go through the network together.
    strict
        End with an error if an image cannot be decoded. Without it, such images are left out and
        counted.
    """

    backend: BackendName | None = None
    threshold: Share | None = None
    min_confidence: Share = 0.01
    most: Count = 20
    views: Annotated[int, Parameter(validator=validators.Number(gte=1, lte=len(TTA_VIEWS)))] = 1
    magnify: bool = False
    batch_size: Count = 16
    strict: Strict = False


@dataclass(frozen=True, slots=True)
class Result:
    """Number of images, and of detections that reached the threshold."""

    images: int
    believed: int


def run(model: Model, recording: In, out: Path, settings: Settings) -> Result:
    """Run a network on every image of a recording.

    Messages of other topics are copied bit for bit; detections that were there are replaced.

    Parameters
    ----------
    model
        A run folder of dmrl train, a .safetensors, a Keras .h5, a quantised model, an export
        folder, or one that ships with dmrl: dmrl-nano for a real camera, dmrl-nano-violet for
        the published images.
    recording
        Recording with images; or a folder of recordings.
    out
        Recording to write: all of IN, and the detections. Must not exist. For a folder: the
        folder of the outputs, under the same names.
    settings
        See `Settings`.

    Raises
    ------
    ModelError
        If the model cannot be used, or not by this backend.
    RecordingError
        If the recording cannot be read, or has no images.
    SettingError
        If the network cannot take images of this size.
    OutputError
        If ``out`` exists.
    """
    from dmrl.deploy.image_detection import DetectionOptions
    from dmrl.prediction import read_model_rates, warn_about_lens, write_detections

    settings, detector, made = _open(model, recording, settings)
    warn_about_lens(model, recording)
    options = DetectionOptions(
        settings.min_confidence, settings.most, settings.views, settings.magnify
    )
    rates = read_model_rates(model)
    return Result(
        *write_detections(recording, out, made, detector, options, settings.batch_size, rates)
    )


def origin(model: Path, recording: Path, settings: Settings) -> "Provenance":
    """Return the provenance of what `run` would write."""
    return _open(model, recording, settings)[2]


def _open(
    model: Path, recording: Path, settings: Settings
) -> "tuple[Settings, Detector, Provenance]":
    """Return settings with a backend, the opened model, and the provenance of its detections."""
    from dmrl.prediction import choose_backend, describe_prediction, open_with_threshold

    if model.suffix == ".mcap":
        raise SettingError(f"{model} is a recording; the model comes first: predict MODEL IN OUT")
    given = settings.backend
    backend = choose_backend(model, recording, given)
    settings = replace(settings, backend=backend)
    detector = open_with_threshold(model, backend, settings.threshold)
    if given is None:
        say(f"{model} runs by {backend}; --backend chooses another")
    made = describe_prediction(model, recording, settings, backend, detector)
    return settings, detector, made


command = stage_command(
    run,
    Closing(columns=("images", "detections over the threshold"), path_key="recording"),
    folder="recording",
)
