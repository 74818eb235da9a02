"""Warnings about intact recordings with implausible values, images and labels."""

from pathlib import Path

import numpy as np
import pytest

import dmrl
from dmrl.images.codec import encode_jpeg, encode_png
from dmrl.recording import RecordingWriter, check
from dmrl.recording.provenance import Provenance
from dmrl.samples.sample import Sample, build_image, build_labels

RNG = np.random.default_rng(0)
TIME_S = np.arange(400) / 50
MOVING_M = 1 + 0.3 * np.sin(TIME_S)


def find_doubts(path: Path) -> list[str]:
    """Return what convert would print about a recording; assert that check finds it too."""
    found = [f"{f.topic} {f.text}" for f in check(path)]
    said = [f"{f.topic} {f.text}" for f in check(path, quick=True, values=True)]
    assert set(said) <= set(found)
    return said


def write_sensors(folder: Path, **columns: np.ndarray) -> Path:
    """Write the height and one range of a robot, metres at 50 Hz, both given by name."""
    path = folder / "a.mcap"
    height = columns.get("height", MOVING_M)
    apart = columns.get("apart", 2 + 0.5 * np.cos(TIME_S))
    with dmrl.writer(path, robots="two") as out:
        out.write_columns("/cf1/height", TIME_S, {"height_m": height})
        out.write_columns("/cf1/range/cf2", TIME_S, {"range_m": apart})
    return path


def test_normal_flight_gives_no_doubt(tmp_path: Path) -> None:
    assert find_doubts(write_sensors(tmp_path)) == []


@pytest.mark.parametrize("beside_m", [0.0, 0.02])
def test_range_that_repeats_the_height_is_doubted(beside_m: float, tmp_path: Path) -> None:
    apart = MOVING_M + beside_m + RNG.normal(0, 0.005, 400)
    (found,) = find_doubts(write_sensors(tmp_path, apart=apart))
    assert "/cf1/range/cf2 100% of the ranges are the robot's own height" in found


def test_a_range_that_never_changes_is_doubted(tmp_path: Path) -> None:
    (found,) = find_doubts(write_sensors(tmp_path, apart=np.full(400, 2.0)))
    assert found == "/cf1/range/cf2 all ranges are 2 m. Does the sensor measure?"


def test_ranges_near_the_height_for_a_while_are_not_doubted(tmp_path: Path) -> None:
    apart = np.where(TIME_S < 6, MOVING_M, MOVING_M + TIME_S)
    assert find_doubts(write_sensors(tmp_path, apart=apart)) == []


@pytest.mark.parametrize(
    ("scale", "words"), [(1e-3, "are under 0.1 m"), (1e3, "are over 100 m. Are they mm or cm?")]
)
def test_ranges_a_thousand_times_off_are_doubted(scale: float, words: str, tmp_path: Path) -> None:
    (found,) = find_doubts(write_sensors(tmp_path, apart=(2 + 0.5 * np.cos(TIME_S)) * scale))
    assert words in found


def test_heights_of_a_rover_are_not_doubted_and_those_in_km_are(tmp_path: Path) -> None:
    assert find_doubts(write_sensors(tmp_path, height=np.full(400, 0.05))) == []
    (tmp_path / "a.mcap").unlink()
    (found,) = find_doubts(write_sensors(tmp_path, height=MOVING_M * 1e-3))
    assert "height_m: 100% of the values are under 0.005 m" in found


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_found(value: float, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    height = MOVING_M.copy()
    height[[3, 70, 399]] = value
    pose = {"position": {"x": height, "y": MOVING_M, "z": MOVING_M}, "orientation": {"w": 1.0}}
    with RecordingWriter(path, Provenance("test")) as out:
        for k in range(400):
            time_ns = int(TIME_S[k] * 1e9)
            out.write_sample(Sample(time_ns, "/cf1/height", "Height", {"height_m": height[k]}))
            place = {axis: float(x[k]) for axis, x in pose["position"].items()}  # type: ignore[union-attr]
            fields = {"pose": {"position": place, "orientation": {"w": 1.0}}}
            fields["timestamp"] = {"seconds": time_ns // 10**9, "nanos": time_ns % 10**9}  # type: ignore[dict-item]
            out.write_sample(Sample(time_ns, "/cf1/pose", "PoseInFrame", fields))
    found = find_doubts(path)
    assert "/cf1/height height_m: 3 values are not finite" in found
    assert "/cf1/pose pose.position.x: 3 values are not finite" in found


def find_image_doubts(folder: Path, pictures: list[bytes], kind: str = "png") -> list[str]:
    """Return the doubts about a recording of these encoded images."""
    path = folder / "a.mcap"
    path.unlink(missing_ok=True)
    with RecordingWriter(path, Provenance("test")) as out:
        for k, data in enumerate(pictures):
            out.write_sample(build_image(50_000_000 * k, "cf1", data, kind))
    found = [text for text in find_doubts(path) if "no calibration" not in text]
    return [text.removeprefix("/cf1/camera/image ") for text in found]


def draw_stripes(level: float, noise: float = 4.0, texture: float = 40.0) -> np.ndarray:
    """Draw vertical stripes: mean grey level, noise and amplitude from 0 to 255."""
    rgb = (
        level
        + texture * np.sin(np.arange(64) / 5)[None, :, None]
        + RNG.normal(0, noise, (48, 64, 3))
    )
    return np.clip(rgb, 0, 255).astype(np.uint8)


@pytest.mark.heavy
def test_working_cameras_give_no_finding(tmp_path: Path) -> None:
    assert find_image_doubts(tmp_path, [encode_png(draw_stripes(120)) for _ in range(30)]) == []
    dusk = [encode_jpeg(draw_stripes(12, texture=10)) for _ in range(30)]
    assert find_image_doubts(tmp_path, dusk, "jpeg") == []
    start = [encode_png(draw_stripes(0, 1, 0))] * 5 + [
        encode_png(draw_stripes(120)) for _ in range(30)
    ]
    assert find_image_doubts(tmp_path, start) == []


def test_a_frozen_camera_is_found(tmp_path: Path) -> None:
    one = encode_png(draw_stripes(120))
    frozen = [*(encode_png(draw_stripes(120)) for _ in range(10)), *[one] * 30]
    assert find_image_doubts(tmp_path, frozen) == ["29 of 40 images repeat the one before them"]


@pytest.mark.parametrize(("level", "what"), [(1, "black"), (250, "of one colour")])
def test_covered_camera_is_found(level: int, what: str, tmp_path: Path) -> None:
    covered = [encode_jpeg(draw_stripes(level, 1.0, 0)) for _ in range(50)]
    (found,) = find_image_doubts(tmp_path, covered, "jpeg")
    assert f"images looked at are {what}. Is it covered?" in found


def find_label_doubts(
    folder: Path, uv: np.ndarray, depth_m: np.ndarray, box: np.ndarray | None
) -> list[str]:
    """Return the doubts about the labels of a recording of 64x48 images, one label each.

    ``uv`` is (N, 2) pixels, ``box`` (N, 4) as written to ``box_px``.
    """
    path = folder / "a.mcap"
    path.unlink(missing_ok=True)
    with RecordingWriter(path, Provenance("test")) as out:
        for k, (u, v) in enumerate(uv.tolist()):
            out.write_sample(
                build_image(50_000_000 * k, "cf1", encode_png(draw_stripes(120)), "png")
            )
            peer = {"peer": "cf2", "u_px": u, "v_px": v, "depth_m": float(depth_m[k])}
            peer |= {"source": "hand"} | ({} if box is None else {"box_px": box[k].tolist()})
            out.write_sample(build_labels(50_000_000 * k, "cf1", [peer], ["hand"]))
    return [text for text in find_doubts(path) if "/cf1/labels" in text]


@pytest.mark.heavy
def test_labels_with_wrong_units_or_boxes_are_doubted(tmp_path: Path) -> None:
    uv = RNG.uniform((12, 12), (52, 36), (30, 2))
    depth_m = RNG.uniform(0.5, 3, 30)
    box = np.column_stack([uv - 5, uv + 5])
    assert find_label_doubts(tmp_path, uv, depth_m, box) == []
    assert find_label_doubts(tmp_path, uv, depth_m, None) == []
    (found,) = find_label_doubts(tmp_path, uv / (64, 48), depth_m, None)
    assert "all lie in the first pixel. Are they normalised?" in found
    (found,) = find_label_doubts(tmp_path, uv, depth_m * 1000, box)
    assert "Is it in mm?" in found
    wide = np.column_stack([uv - 5, np.full((30, 2), 10)])  # left, top, width, height
    (found,) = find_label_doubts(tmp_path, uv, depth_m, wide)
    assert "have boxes without area. Are they left, top, right, bottom?" in found
    (found,) = find_label_doubts(tmp_path, uv, depth_m, RNG.permutation(box))
    assert "of 30 labels of source 'hand' have their centre outside their box" in found
