"""``dmrl align`` by camera images and motion capture."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import RecordingError, SettingError
from dmrl.images.codec import encode_jpeg
from dmrl.messages import message_class
from dmrl.recording import RecordingWriter, build_provenance, read_raw, read_summary, read_table
from dmrl.simulation.settings import Preset
from dmrl.stages import fly
from dmrl.stages.align import METADATA, Settings, run

Wrong = Callable[[float], float]
OFFSET_S, DRIFT = 0.080, 20e-6
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 160, 112, 92.0


def make_wrong_clock(duration_s: float) -> Wrong:
    """Return a clock that is 80 ms ahead in the middle of a flight and runs 20 ppm fast."""
    return lambda time_s: time_s + OFFSET_S + DRIFT * (time_s - duration_s / 2)


def find_worst_error_s(before: Path, after: Path, topic: str) -> float:
    """Return the largest difference of a topic's times in two recordings, seconds."""
    old, new = (read_table(p, topic, fields=[])["log_time"].to_numpy() for p in (before, after))
    return float(np.abs(old - new).max() * 1e-9)


def make_panorama() -> np.ndarray:
    """Return a (224, 1024) grey panorama with structure of all sizes."""
    rng, scene = np.random.default_rng(5), np.zeros((224, 1024))
    for size in (4, 8, 16, 32):
        coarse = rng.normal(size=(224 // size, 1024 // size))
        scene += np.kron(coarse, np.ones((size, size)))
    return np.asarray(128 + 30 * scene)


def write_turning_camera(path: Path, duration_s: float, wrong: Wrong, rate_hz: float) -> None:
    """Write a drone that yaws, and the images of its camera with the times of a wrong clock.

    The images are noisy and darker in the corners.
    """
    rng, scene = np.random.default_rng(1), make_panorama()
    waves = [(rng.uniform(0.1, 0.3), rng.uniform(0.3, 3), rng.uniform(0, 6)) for _ in range(6)]
    row, col = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    dim = 1 - 0.4 * np.hypot(row / HEIGHT_PX - 0.5, col / WIDTH_PX - 0.5) ** 2

    def yaw(time_s: float) -> float:
        return sum(a * np.sin(w * time_s + p) for a, w, p in waves)

    def rate(time_s: float) -> float:
        return sum(a * w * np.cos(w * time_s + p) for a, w, p in waves)

    with RecordingWriter(path, build_provenance("test")) as sink:
        for time_s in np.arange(1, duration_s + 1, 0.01).tolist():
            noisy = rate(time_s) + rng.normal(0, 0.02)
            sink.write(
                round(time_s * 1e9),
                "/cf1/attitude",
                message_class("Attitude")(yaw_rate_radps=noisy, pitch_rad=rng.normal(0, 0.001)),
            )
        for time_s in np.arange(1, duration_s + 1, 1 / rate_hz).tolist():
            left = 512 - WIDTH_PX // 2 - FOCAL_PX * yaw(time_s)
            columns = left + np.arange(WIDTH_PX)
            first = np.floor(columns).astype(int)
            part = columns - first
            seen = scene[56 : 56 + HEIGHT_PX]
            view = seen[:, first % 1024] * (1 - part) + seen[:, (first + 1) % 1024] * part
            grey = np.clip(view * dim + rng.normal(0, 6, view.shape), 0, 255).astype(np.uint8)
            data = encode_jpeg(np.stack([grey] * 3, axis=2), 80)
            picture = message_class("CompressedImage")(data=data, format="jpeg")
            sink.write(round(wrong(time_s) * 1e9), "/cf1/camera/image", picture)


def measure_camera_error_s(folder: Path, duration_s: float) -> float:
    """Align a camera by its images; return the largest error of its times, seconds."""
    spoilt, out = folder / "in.mcap", folder / "out.mcap"
    write_turning_camera(spoilt, duration_s, make_wrong_clock(duration_s), 20.0)
    clocks = run(spoilt, out, Settings(cameras=True))
    assert list(clocks) == ["cf1/camera"]
    assert clocks["cf1/camera"].by == "yaw rate"
    assert find_worst_error_s(spoilt, out, "/cf1/attitude") == 0
    times = read_table(out, "/cf1/camera/image", fields=[])["log_time"].to_numpy()
    true = 1e9 * (1 + np.arange(len(times)) / 20.0)
    (told,) = read_summary(out).metadata[METADATA]
    assert '"by": "yaw rate"' in told["cf1/camera"]
    return float(np.abs(times - true).max() * 1e-9)


@pytest.mark.heavy
def test_camera_is_aligned_by_its_image_motion(tmp_path: Path) -> None:
    assert measure_camera_error_s(tmp_path, 40.0) < 0.005


@pytest.mark.slow
def test_camera_is_aligned_to_5_ms_over_5_minutes(tmp_path: Path) -> None:
    assert measure_camera_error_s(tmp_path, 300.0) < 0.005


def measure_mocap_errors_s(folder: Path, duration_s: float, noise: Preset) -> list[float]:
    """Align two robots to motion capture; return the largest error of each, seconds."""
    true, spoilt, out = folder / "true.mcap", folder / "in.mcap", folder / "out.mcap"
    fly.run(true, fly.Settings(duration_s=duration_s, noise=noise, trajectory="random", seed=4))
    wrong = make_wrong_clock(duration_s)
    with RecordingWriter(spoilt, build_provenance("test")) as sink:
        for raw in read_raw(true):
            is_log = raw.topic.split("/")[-1] in ("attitude", "velocity", "height")
            if is_log or raw.topic == "/tf":
                time_ns = round(wrong(raw.time_ns * 1e-9) * 1e9) if is_log else raw.time_ns
                sink.write_raw(replace(raw, time_ns=time_ns))
    clocks = run(spoilt, out, Settings(mocap=True, reference="mocap"))
    assert clocks.keys() == {"mocap", "cf1", "cf2"}
    assert find_worst_error_s(true, out, "/tf") == 0
    return [find_worst_error_s(true, out, f"/{robot}/attitude") for robot in ("cf1", "cf2")]


@pytest.mark.heavy
def test_robots_are_aligned_to_motion_capture(tmp_path: Path) -> None:
    assert max(measure_mocap_errors_s(tmp_path, 40.0, "calibrated")) < 0.005


@pytest.mark.slow
def test_robots_are_aligned_to_motion_capture_to_5_ms_over_5_minutes(tmp_path: Path) -> None:
    assert max(measure_mocap_errors_s(tmp_path, 300.0, "realistic")) < 0.005


@pytest.mark.heavy
def test_unalignable_cameras_and_poses_give_one_line_errors(tmp_path: Path) -> None:
    path, out = tmp_path / "in.mcap", tmp_path / "out.mcap"
    fly.run(path, fly.Settings(duration_s=2.0, camera=True, camera_rate_hz=2.0))
    with pytest.raises(SettingError, match=r"has labels already\. Align before that"):
        run(path, out, Settings(cameras=True))
    still = tmp_path / "still.mcap"
    with RecordingWriter(still, build_provenance("test")) as sink:
        data = encode_jpeg(np.zeros((48, 64, 3), np.uint8))
        for k in range(60):
            sink.write(k * 10**9, "/cf1/attitude", message_class("Attitude")())
            sink.write(k * 10**9, "/cf1/camera/image", message_class("CompressedImage")(data=data))
    with pytest.raises(RecordingError, match="no camera saw its robot turn"):
        run(still, out, Settings(cameras=True))
    with pytest.raises(RecordingError, match=r"no poses of robots .* Leave out --mocap"):
        run(still, out, Settings(mocap=True))
    with pytest.raises(RecordingError, match="no robot ranged to another"):
        run(still, out, Settings())
    assert not out.exists()
