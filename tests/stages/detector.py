"""Simulated detections on a simulated flight, without rendering its images."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.geometry.frames import AIDECK, Array, Camera, is_inside, pixels_from_horizontal
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read_raw, read_summary, read_table

RATE_HZ = 10.0


def with_detections(
    flight: Path,
    out: Path,
    robot: str = "cf1",
    camera: Camera = AIDECK,
    seed: int = 0,
    tilt: tuple[NDArray[np.int64], Array, Array] | None = None,
    rate_hz: float = RATE_HZ,
) -> Path:
    """Copy a flight and add detections of ``robot``; return the path of the copy.

    Errors have standard deviations of 3 px, of 15 % of the depth, and of another 8 % that lasts
    about a second. One detection in six is missed, and one image in four has a false alarm.

    ``camera`` takes the images, but the recorded calibration is that of the AI deck. ``tilt`` holds
    times in nanoseconds, roll and pitch in radians of the camera; without it, those of the log.
    """
    rng = np.random.default_rng(seed)
    held = read_summary(flight)
    span_ns = held.start_ns, held.end_ns
    times_ns = np.arange(span_ns[0] + 10**9, span_ns[1] - 10**9, round(1e9 / rate_hz))
    taken_ns = times_ns - round(camera.delay_s * 1e9)
    at_ns, *tilted = tilt or _read_tilt(flight, robot)
    roll, pitch = (np.interp(taken_ns, at_ns, angle) for angle in tilted)
    found: list[list[dict[str, float]]] = [[] for _ in times_ns]
    for topic in held.topics:
        link = topics.parse_topic(topics.TRUTH, topic)
        if link is None or link["robot"] != robot:
            continue
        truth = read_table(flight, topic)
        true_ns = truth["log_time"].to_numpy()
        xyz = np.column_stack([np.interp(taken_ns, true_ns, truth[a].to_numpy()) for a in "xyz"])
        uv, depth_m, _ = pixels_from_horizontal(xyz, roll, pitch, camera)
        shown = is_inside(uv, 320, 224) & (depth_m > 0) & (rng.random(len(uv)) < 5 / 6)
        lasting = np.interp(times_ns, times_ns[::10], rng.normal(0, 0.08, len(times_ns[::10])))
        depth_m = depth_m * np.exp(lasting + rng.normal(0, 0.15, len(uv)))
        uv = uv + rng.normal(0, 3.0, uv.shape)
        for k in np.flatnonzero(shown):
            found[k].append(_make_detection(uv[k, 0], uv[k, 1], depth_m[k], rng.uniform(0.5, 1.0)))
    for entries in found:
        if rng.random() < 0.25:
            u, v = rng.uniform((0, 0), (320, 224))
            entries.append(_make_detection(u, v, rng.uniform(0.3, 4.0), rng.uniform(0.4, 0.7)))
        entries.sort(key=lambda d: -d["confidence"])
    with RecordingWriter(out, Provenance("test")) as sink:
        for raw in read_raw(flight):
            sink.write_raw(raw)
        k = np.ravel(AIDECK.image_from_optical).tolist()
        calibration = message_class("CameraCalibration")(
            width=320, height=224, K=k, D=list(AIDECK.distortion), distortion_model="plumb_bob"
        )
        sink.write(int(times_ns[0]), topics.CALIBRATION(robot), calibration)
        for time_ns, entries in zip(times_ns.tolist(), found, strict=True):
            made = message_class("Detections")(detections=entries, threshold=0.3)
            sink.write(time_ns, topics.DETECTIONS(robot), made)
    return out


def _read_tilt(flight: Path, robot: str) -> tuple[NDArray[np.int64], Array, Array]:
    """Return times in nanoseconds, roll and pitch in radians of a robot's log."""
    table = read_table(flight, topics.ATTITUDE(robot))
    columns = (table[name].to_numpy() for name in ("log_time", "roll_rad", "pitch_rad"))
    times_ns, roll, pitch = columns
    return times_ns, roll, pitch


def _make_detection(
    u_px: float, v_px: float, depth_m: float, confidence: float
) -> dict[str, float]:
    """Return the fields of a detection."""
    values = {"u_px": u_px, "v_px": v_px, "depth_m": depth_m, "confidence": confidence}
    return {name: float(value) for name, value in values.items()}
