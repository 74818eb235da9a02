"""``dmrl predict``: a model and a recording to a recording with detections."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from cyclopts import Parameter, validators
from numpy.typing import NDArray

from dmrl import topics
from dmrl.deploy.detector import LIBRARIES, BackendName, Detector, fastest, open_detector
from dmrl.errors import MissingTopic
from dmrl.guards import limits
from dmrl.images.codec import Opened, Rgb, opened, size
from dmrl.images.prefetch import ahead
from dmrl.learn.inference.decode_grids import PER_DETECTION, Found, Grids
from dmrl.learn.inference.decode_grids import decode as find
from dmrl.learn.inference.tta import VIEWS, agreed, returned, shown
from dmrl.learn.pretrained import resolved
from dmrl.messages import message
from dmrl.pipeline.batch import is_many, over_folder
from dmrl.recording import (
    Provenance,
    RawMessage,
    Stamped,
    Summary,
    Timed,
    parsed,
    provenance,
    read,
    read_raw,
    rewrite,
    summary,
)
from dmrl.recording.provenance_inputs import sha256_of_file
from dmrl.terminal.arguments import AsJson, Flat, In, On, Workers
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_table

Map = NDArray[np.floating]
OWN = (topics.DETECTIONS, topics.GRID)

Share = Annotated[float, Parameter(validator=validators.Number(gte=0, lte=1))]
Positive = Annotated[int, Parameter(validator=validators.Number(gte=1))]


@dataclass(frozen=True, slots=True)
class Settings:
    """How a network is run.

    Parameters
    ----------
    backend
        What computes. torch and onnx are float; onnx-int8, integer (NumPy), c and riscv32 (the C
        in an emulator, seconds an image) are int8, and need a quantised model or an export
        folder. Without it, onnx where it is installed and gives all that the network says, else
        torch.
    threshold
        Confidence from which detections are to be believed, written beside them, 0 to 1.
        Without it, the model's.
    min_confidence
        Leave out detections below this, 0 to 1; the best of each image stays.
    most
        Keep at most this many detections per image.
    views
        Look at every image so many times, 1 to 12, mirrored and shifted by parts of a cell, and
        take the medians. For dmrl label --detections: errors a quarter smaller, and so many times
        the work. Maps are of the first.
    batch_size
        Images that go through the network together.
    """

    backend: BackendName | None = None
    threshold: Share | None = None
    min_confidence: Share = 0.01
    most: Positive = 20
    views: Annotated[int, Parameter(validator=validators.Number(gte=1, lte=len(VIEWS)))] = 1
    batch_size: Positive = 16


@dataclass(frozen=True, slots=True)
class Result:
    """How many images went through, and how many detections reached the threshold."""

    images: int
    believed: int


def run(model: Path, recording: Path, out: Path, settings: Settings) -> Result:
    """Copy ``recording`` to ``out`` with the detections of ``model`` in every image.

    Messages of other topics are copied bit for bit; detections that were there are replaced.

    Parameters
    ----------
    model
        Run folder, .safetensors, Keras .h5, quantised model or export folder.
    recording
        With images of one robot or more.
    out
        Recording to write. Must not exist.
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
    held = summary(recording)
    if not topics.robots(list(held.topics)):
        raise MissingTopic(topics.camera_image("*"), held.topics, recording)
    settings = _settled(model, recording, settings)
    detector = _detector(model, settings)
    replaced = [t for t in held.topics if any(topics.names(own, t) for own in OWN)]
    seen = Counter[str]()
    found = _messages(recording, held, detector, settings, seen)
    made = _provenance(model, recording, settings, detector)
    rewrite(recording, out, made, without=replaced, fresh=[found])
    return Result(seen["images"], seen["believed"])


def origin(model: Path, recording: Path, settings: Settings) -> Provenance:
    """Provenance of what `run` would write."""
    settings = _settled(model, recording, settings)
    return _provenance(model, recording, settings, _detector(model, settings))


def _settled(model: Path, recording: Path, settings: Settings) -> Settings:
    """The settings with a backend, said where it was not asked for."""
    first = next(read(recording, topics.camera_image("*")), None)
    if settings.backend is not None or first is None:
        return replace(settings, backend=settings.backend or "torch")
    width_px, height_px, _ = size(first.message.data, _named(recording, first))
    backend = fastest(resolved(model), (width_px, height_px))
    say(f"{recording}: --backend {backend}")
    return replace(settings, backend=backend)


def _detector(model: Path, settings: Settings) -> Detector:
    detector = open_detector(resolved(model), settings.backend or "torch")
    if settings.threshold is not None:
        detector = replace(detector, threshold=settings.threshold)
    return detector


def _provenance(model: Path, recording: Path, settings: Settings, detector: Detector) -> Provenance:
    libraries = LIBRARIES[settings.backend or "torch"]
    model = resolved(model)
    made = provenance("predict", settings, (model, recording), libraries=libraries)
    # It stands beside the weights, and in every message.
    made = replace(made, settings={**made.settings, "model_threshold": detector.threshold})
    if model.is_dir() and detector.file is not None:
        # The log of a training tells when it ran; the weights alone decide what is predicted.
        weights = replace(made.inputs[0], sha256=sha256_of_file(detector.file))
        made = replace(made, inputs=(weights, *made.inputs[1:]))
    return made


def _messages(
    recording: Path, held: Summary, detector: Detector, settings: Settings, tally: Counter[str]
) -> Iterator[Timed]:
    """Of every image its detections and the map they were found in; counted on the way."""
    pictured = [t for t in held.topics if topics.names(topics.CAMERA_IMAGE, t)]
    total = sum(held.topics[t].count for t in pictured)
    raws = track(read_raw(recording, *pictured), "Predicting", total)
    batches = _batches(raws, settings.batch_size, detector, recording)
    for batch in ahead(_decoded, batches, threads=1, held=1):
        seen = _seen([rgb for _, rgb in batch], detector, settings)
        tally["images"] += len(seen)
        for (raw, _), (made, grid) in zip(batch, seen, strict=True):
            tally["believed"] += sum(d.confidence >= detector.threshold for d in made.detections)
            robot = _robot(raw)
            yield Timed(raw.time_ns, topics.detections(robot), made, raw.publish_ns)
            yield Timed(raw.time_ns, topics.grid(robot), grid, raw.publish_ns)


def _batches(
    raws: Iterable[RawMessage], most: int, detector: Detector, recording: Path
) -> Iterator[list[tuple[RawMessage, Opened]]]:
    """So many images at a time; fewer where they are large, one at least."""
    batch: list[tuple[RawMessage, Opened]] = []
    pixels = 0
    for raw in raws:
        what = _named(recording, raw)
        picture = opened(parsed(raw, message("CompressedImage"), recording).data, what)
        detector.require_size(picture.width_px, picture.height_px, what)
        pixels += picture.width_px * picture.height_px
        if len(batch) == most or (batch and pixels > limits.FRAME_PIXELS):
            yield batch
            batch, pixels = [], picture.width_px * picture.height_px
        batch.append((raw, picture))
    if batch:
        yield batch


def _decoded(batch: list[tuple[RawMessage, Opened]]) -> list[tuple[RawMessage, Rgb]]:
    return [(raw, picture.decode(limits.FRAME_PIXELS)) for raw, picture in batch]


def _robot(raw: RawMessage) -> str:
    return (topics.names(topics.CAMERA_IMAGE, raw.topic) or {})["robot"]


def _named(recording: Path, image: RawMessage | Stamped) -> str:
    return f"{recording}: the image of {image.topic} at {image.time_ns} ns"


class _Seen(NamedTuple):
    """The messages of one image: Detections, and the GridMap they were found in."""

    message: Any
    grid: Any


def _seen(pictures: list[Rgb], detector: Detector, settings: Settings) -> list[_Seen]:
    """What the network finds in each picture."""
    out = []
    for _, same_size in groupby(pictures, key=np.shape):
        images = list(same_size)
        grids = detector.grids(images)
        found = _found(images, grids, detector, settings)
        for k in range(len(found.count)):
            grid = _grid(grids.confidence[k], grids.depth_m[k], detector.stride_px)
            out.append(_Seen(_detections(found, k, detector.threshold), grid))
    return out


def _found(images: list[Rgb], grids: Grids, detector: Detector, settings: Settings) -> Found:
    """Detections in these images, whose grids are known, over all views."""
    stride_px, (height_px, width_px, _) = detector.stride_px, images[0].shape
    most, least = settings.most, settings.min_confidence
    decoded = partial(find, stride_px=stride_px, most=most, min_confidence=least)
    found = [decoded(*grids)]
    for view in VIEWS[1 : settings.views]:
        again = decoded(*detector.grids(shown(np.stack(images), view, stride_px)))
        found.append(returned(again, view, stride_px, (height_px, width_px)))
    return agreed(found, most=most, min_confidence=least) if len(found) > 1 else found[0]


def _detections(found: Found, image: int, threshold: float) -> Any:
    columns = [getattr(found, name)[image, : found.count[image]] for name in PER_DETECTION]
    rows = zip(*(column.tolist() for column in columns), strict=True)
    detections = [dict(zip(PER_DETECTION, row, strict=True)) for row in rows]
    return message("Detections")(detections=detections, threshold=threshold)


def _grid(confidence: Map, depth_m: Map, stride_px: int) -> Any:
    rows, cols = confidence.shape
    return message("GridMap")(
        rows=rows,
        cols=cols,
        channels=("confidence", "depth_m"),
        data=np.stack((confidence, depth_m)).astype("<f4").tobytes(),
        stride_px=stride_px,
    )


DEFAULTS = Settings()


def command(
    model: Path,
    recording: In,
    out: Path,
    /,
    *,
    settings: Flat[Settings] = DEFAULTS,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> None:
    """Run a network on every image of a recording.

    Parameters
    ----------
    model
        A run folder of dmrl train, a .safetensors, a Keras .h5, a quantised model, an export
        folder, or one that ships with dmrl: dmrl-nano for a real camera, dmrl-nano-violet for
        the published images.
    recording
        Recording with images; or a folder of recordings.
    out
        Recording to write: all of IN, and what was detected. Must not exist. For a folder: the
        folder of what is made, under the same names.
    workers
        Of a folder: recordings at a time, at most. Without it, as many as there are cores.
        Changes no byte.
    as_json
        Print one JSON document in place of the table.
    """
    if is_many(recording) or on is not None:
        given = {"model": model}
        over_folder(
            "predict",
            recording,
            out,
            settings,
            workers=workers,
            on=on,
            as_json=as_json,
            inputs=given,
        )
        return
    result = run(model, recording, out, settings)
    if as_json:
        print_json({"recording": str(out), **asdict(result)})
        return
    columns = ("images", "detections over the threshold")
    print_table(str(out), columns, [(result.images, result.believed)])
