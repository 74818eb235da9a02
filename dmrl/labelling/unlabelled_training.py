"""Training on a dataset and on flights without labels, by the poses of their cameras."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dmrl import topics
from dmrl.datasets.training import Given, Result, train_network
from dmrl.errors import MissingTopic, RecordingError
from dmrl.geometry.frames import Array
from dmrl.images.codec import Rgb, decode
from dmrl.labelling.flight_log import OBSERVER_TOPICS, read_flight
from dmrl.labelling.observer_log import read_observer_log
from dmrl.labelling.recorded_camera import require_camera
from dmrl.learn.pretrained import resolve_model_path
from dmrl.learn.training.config import TrainConfig
from dmrl.learn.training.consistency import UnlabelledImages
from dmrl.recording import read


def train_with_flights(
    dataset: Path,
    out: Path,
    settings: TrainConfig,
    *,
    init: Path | None = None,
    teacher: Path | None = None,
    unlabelled: Sequence[Path] = (),
    resume: bool = False,
) -> Result:
    """Train on a dataset, and on the flights in ``unlabelled`` by the consistency loss.

    The other parameters are those of `Given`, and the errors those of `train_network` and
    `read_unlabelled`.
    """
    start, guide = (path and resolve_model_path(path) for path in (init, teacher))
    flights = read_unlabelled(unlabelled) if unlabelled else None
    return train_network(dataset, out, settings, Given(start, guide, flights, resume))


def read_unlabelled(paths: Sequence[Path]) -> UnlabelledImages:
    """Read the images with detections of every robot of some recordings, and the robots' odometry.

    Raises
    ------
    MissingTopic
        If a recording lacks detections or a calibration.
    RecordingError
        If it cannot be read, or images differ in size.
    """
    pixels: list[Rgb] = []
    poses: list[Array] = []
    flights: list[int] = []
    camera_number = 0
    for number, path in enumerate(paths):
        flight = read_flight(path, *OBSERVER_TOPICS)
        if not flight.detections:
            raise MissingTopic(topics.DETECTIONS("*"), flight.topics, path)
        for robot in sorted(flight.detections):
            camera = require_camera(flight, robot)
            log = read_observer_log(flight, robot, camera, None)
            lens = camera.image_from_optical[[0, 1, 0, 1], [0, 1, 2, 2]]
            constant = np.tile([*lens, camera_number], (len(log.time_ns), 1))
            time_s = (log.time_ns - flight.start_ns) * 1e-9
            rows = np.column_stack([time_s, log.path_m, log.yaw_rad, log.attitude_rad, constant])
            of_time = dict(zip(log.log_time_ns.tolist(), rows, strict=True))
            camera_number += 1
            for image in read(path, topics.CAMERA_IMAGE(robot)):
                if image.time_ns in of_time:
                    pixels.append(decode(image.message.data, f"{path}: {image.topic}"))
                    poses.append(of_time[image.time_ns])
                    flights.append(number)
    if len({one.shape for one in pixels}) != 1:
        names = ", ".join(map(str, paths))
        raise RecordingError(f"{names}: no images, or of more than one size. Give other flights")
    return UnlabelledImages(
        tuple(paths), np.stack(pixels), np.array(poses, np.float32), np.array(flights)
    )
