"""Run a network on the images of a recording, and write its detections."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dmrl import topics
from dmrl.datasets.manifest import have_similar_focal_lengths
from dmrl.datasets.writing.inputs import find_focal_lengths
from dmrl.deploy.backend_names import BackendName
from dmrl.deploy.detector import (
    BACKEND_PACKAGES,
    Detector,
    open_detector,
    read_focal_lengths,
    read_rates,
    select_fastest_backend,
)
from dmrl.deploy.image_detection import DetectionOptions, detect_images
from dmrl.errors import MissingTopic, RecordingError, SettingError, SourceError
from dmrl.guards import limits
from dmrl.guards.memory import return_large_blocks
from dmrl.images.codec import UNDECODABLE, ImageHeader, Rgb, read_header
from dmrl.images.prefetch import map_ahead
from dmrl.learn.inference.decode_grids import DETECTION_COLUMNS, Detections, Grids
from dmrl.learn.pretrained import resolve_model_path
from dmrl.messages import message_class
from dmrl.recording import (
    LoadedRecording,
    Provenance,
    RawMessage,
    build_provenance,
    parse_message,
    read_raw,
    rewrite,
)
from dmrl.recording.provenance_inputs import hash_file
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import leave_out
from dmrl.terminal.progress import say, track

OTHER_SIZE = "images of a size that the model does not take"
OUTPUT_TOPICS = (topics.DETECTIONS, topics.GRID)
"""Topics that are written; those of before are replaced."""


def choose_backend(model: Path, recording: Path, given: BackendName | None) -> BackendName:
    """Return the given backend, or the fastest float one for the images of a recording.

    Raises
    ------
    MissingTopic
        If the recording has no images.
    """
    held = LoadedRecording(recording)
    robots = topics.list_robots(list(held.topics))
    if not robots:
        raise MissingTopic(topics.CAMERA_IMAGE("*"), held.topics, recording)
    sizes = (held.read_image_size(topics.CAMERA_IMAGE(robot)) for robot in robots if given is None)
    if (size_px := next(filter(None, sizes), None)) is None:
        return given or "torch"
    return select_fastest_backend(resolve_model_path(model), size_px)


def open_with_threshold(model: Path, backend: BackendName, threshold: float | None) -> Detector:
    """Open a model, with another threshold than its own if one is given."""
    detector = open_detector(resolve_model_path(model), backend)
    return detector if threshold is None else replace(detector, threshold=threshold)


def read_model_rates(model: Path) -> dict[str, Any] | None:
    """Return the rates of a model, see `read_rates`; None without them."""
    return read_rates(resolve_model_path(model))


def warn_about_lens(model: Path, recording: Path) -> None:
    """Warn if a camera has another focal length than those that a model was trained with.

    The size of a robot in the image is all that a network has for its depth.
    """
    known_px = read_focal_lengths(resolve_model_path(model))
    for own_px in find_focal_lengths(LoadedRecording(recording)) if known_px else ():
        if not any(have_similar_focal_lengths(own_px, px) for px in known_px):
            say(
                f"{recording}: the focal length is {own_px:.0f} px, and {model} was trained with "
                f"{' and '.join(f'{px:.0f}' for px in known_px)}: its depths are about "
                f"{known_px[0] / own_px:.2f} times the true ones. Train with your own images: "
                "docs/own_camera.md"
            )
            return


def describe_prediction(
    model: Path, recording: Path, settings: Any, backend: BackendName, detector: Detector
) -> Provenance:
    """Return the provenance of predictions.

    Parameters
    ----------
    model, recording
        Its inputs.
    settings
        Settings of the stage, with the backend.
    backend, detector
        The opened model.
    """
    model = resolve_model_path(model)
    made = build_provenance(
        "predict", settings, (model, recording), libraries=BACKEND_PACKAGES[backend]
    )
    return describe_weights(made, model, detector)


def describe_weights(made: Provenance, model: Path, detector: Detector) -> Provenance:
    """Return a provenance, whose first input is a model, with its threshold and weights alone."""
    # It stands beside the weights, and in every message.
    made = replace(made, settings={**made.settings, "model_threshold": detector.threshold})
    if model.is_dir() and detector.file is not None:
        # A run folder holds the log of the training too; the weights alone decide the result.
        weights = replace(made.inputs[0], sha256=hash_file(detector.file))
        made = replace(made, inputs=(weights, *made.inputs[1:]))
    return made


def write_detections(
    recording: Path,
    out: Path,
    origin: Provenance,
    detector: Detector,
    options: DetectionOptions,
    batch_size: int,
    rates: dict[str, Any] | None,
) -> tuple[int, int]:
    """Copy a recording with the detections in every image.

    Parameters
    ----------
    recording, out
        Recording to read, and recording to write.
    origin
        Provenance of ``out``.
    detector, options
        The opened model, and the options of the detection.
    batch_size
        Most images that go through the network together.
    rates
        The model's rates, as of `read_rates`.

    Returns
    -------
    tuple
        Number of images, and of detections that reach the threshold.
    """
    held = LoadedRecording(recording)
    replaced = [t for t in held.topics if any(topics.parse_topic(own, t) for own in OUTPUT_TOPICS)]
    tally = Counter[str]()
    found = _iter_messages(held, detector, options, batch_size, tally, rates)
    rewrite(recording, out, origin, without=replaced, fresh=[found])
    return tally["images"], tally["believed"]


def _iter_messages(
    held: LoadedRecording,
    detector: Detector,
    options: DetectionOptions,
    batch_size: int,
    tally: Counter[str],
    rates: dict[str, Any] | None,
) -> Iterator[Sample]:
    """Yield Detections and GridMap of every image, and count them on the way."""
    images = [t for t in held.topics if topics.parse_topic(topics.CAMERA_IMAGE, t)]
    total = sum(held.topics[t].count for t in images)
    raws = track(read_raw(held.path, *images), "Predicting", total)
    misfits: list[SettingError] = []
    batches = _iter_batches(raws, batch_size, detector, held.path, misfits)
    count = Counter[str]()  # images of each camera
    for decoded in map_ahead(_decode_batch, batches, threads=1, max_waiting=1):
        batch = list(_iter_usable(decoded))
        tally["images"] += len(batch)
        raw_messages = iter(batch)
        magnified = [options.magnify and _is_second(raw.topic, count) for raw, _ in batch]
        pixels = [rgb for _, rgb in batch]
        for found, grids in detect_images(pixels, detector, options, magnified):
            for k in range(len(found.count)):
                raw, _ = next(raw_messages)
                fields = detection_fields(found, k, detector.threshold, rates)
                tally["believed"] += sum(
                    d["confidence"] >= detector.threshold for d in fields["detections"]
                )
                robot = (topics.parse_topic(topics.CAMERA_IMAGE, raw.topic) or {})["robot"]
                topic = topics.DETECTIONS(robot)
                yield Sample(raw.time_ns, topic, "Detections", fields, raw.publish_ns)
                grid = grid_fields(grids, k, detector.stride_px)
                yield Sample(raw.time_ns, topics.GRID(robot), "GridMap", grid, raw.publish_ns)
    if misfits and not tally["images"]:
        raise misfits[0]
    if total and not tally["images"]:
        raise RecordingError(f"{held.path}: no image can be decoded. Restore the recording")


def _is_second(camera: str, count: Counter[str]) -> bool:
    """Return whether an image of a camera is the second of two, and count it."""
    count[camera] += 1
    return count[camera] % 2 == 0


def _iter_batches(
    raws: Iterable[RawMessage],
    most: int,
    detector: Detector,
    recording: Path,
    misfits: list[SettingError],
) -> Iterator[list[tuple[RawMessage, ImageHeader]]]:
    """Yield so many images at a time; fewer where they are large, one at least.

    ``misfits`` receives the error of the first image of a size that the detector does not take.
    """
    batch: list[tuple[RawMessage, ImageHeader]] = []
    pixels = 0
    for raw in raws:
        name = f"{recording}: the image of {raw.topic} at {raw.time_ns} ns"
        data = parse_message(raw, message_class("CompressedImage"), recording).data
        try:
            image = read_header(data, name)
        except SourceError as e:
            leave_out(UNDECODABLE, e)
            continue
        try:
            detector.require_size(image.width_px, image.height_px, name)
        except SettingError as e:
            leave_out(OTHER_SIZE, e)
            misfits[:] = misfits or [e]
            continue
        pixels += image.width_px * image.height_px
        if image.width_px * image.height_px > limits.LARGE_PIXELS:
            return_large_blocks()
        if len(batch) == most or (batch and pixels > limits.FRAME_PIXELS):
            yield batch
            batch, pixels = [], image.width_px * image.height_px
        batch.append((raw, image))
    if batch:
        yield batch


def _decode_batch(
    batch: list[tuple[RawMessage, ImageHeader]],
) -> list[tuple[RawMessage, Rgb | SourceError]]:
    return [(raw, _decode_or_fail(image)) for raw, image in batch]


def _decode_or_fail(image: ImageHeader) -> Rgb | SourceError:
    try:
        return image.decode(limits.FRAME_PIXELS)
    except SourceError as e:
        return e


def _iter_usable(
    decoded: list[tuple[RawMessage, Rgb | SourceError]],
) -> Iterator[tuple[RawMessage, Rgb]]:
    for raw, rgb in decoded:
        if isinstance(rgb, SourceError):
            leave_out(UNDECODABLE, rgb)
        else:
            yield raw, rgb


def detection_fields(
    found: Detections, image: int, threshold: float, rates: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return the fields of the Detections of the image with this number."""
    columns = [getattr(found, name)[image, : found.count[image]] for name in DETECTION_COLUMNS]
    rows = zip(*(column.tolist() for column in columns), strict=True)
    detections = [dict(zip(DETECTION_COLUMNS, row, strict=True)) for row in rows]
    return {"detections": detections, "threshold": threshold, "rates": rates}


def grid_fields(grids: Grids, image: int, stride_px: int) -> dict[str, Any]:
    """Return the fields of the GridMap of the image with this number."""
    maps = np.stack((grids.confidence[image], grids.depth_m[image]))
    return {
        "rows": maps.shape[1],
        "cols": maps.shape[2],
        "channels": ("confidence", "depth_m"),
        "data": maps.astype("<f4").tobytes(),
        "stride_px": stride_px,
    }
