"""Recorded CPX streams become images, calibrations and states."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SettingError, SourceError
from dmrl.formats.aideck import wifi_stream
from dmrl.formats.aideck.cpx import Encoding, Image, Layout
from dmrl.formats.aideck.cpx_encode import pack_image
from dmrl.formats.aideck.cpx_state import RobotState
from dmrl.formats.base import Options
from dmrl.formats.registry import find_format
from dmrl.geometry.frames import AIDECK, Camera
from dmrl.images.bayer import demosaic
from dmrl.images.codec import decode, encode_jpeg
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import count_left_out

from .. import foreign
from ..reading import group_by_topic


def read_samples(
    path: Path, data: bytes, options: Options | None = None
) -> dict[str, list[Sample]]:
    """Write a stream to a file; return its samples by topic."""
    path.write_bytes(data)
    return group_by_topic(wifi_stream.load_content(path, options or Options()).samples)


def test_raw_pictures_get_their_colours_and_nominal_times(tmp_path: Path) -> None:
    raw = foreign.make_raw_images(3)
    data = b"".join(pack_image(Image(32, 24, "raw", p.tobytes())) for p in raw)
    found = read_samples(tmp_path / "a.cpx", data, Options(rate_hz=20))["/cf1/camera/image"]
    assert [s.time_ns for s in found] == [0, 50_000_000, 100_000_000]
    for sample, pixels in zip(found, raw, strict=True):
        np.testing.assert_array_equal(decode(sample.fields["data"]), demosaic(pixels))
    assert find_format(tmp_path / "a.cpx").name == "aideck-stream"


def test_a_camera_that_is_given_comes_once_before_the_pictures(tmp_path: Path) -> None:
    raw = foreign.make_raw_images(3)
    data = b"".join(pack_image(Image(32, 24, "raw", p.tobytes())) for p in raw)
    camera = replace(AIDECK, width_px=32, height_px=24)
    found = read_samples(tmp_path / "a.cpx", data, Options(rate_hz=20, camera=camera))
    (calibration,) = found["/cf1/camera/calibration"]
    assert calibration.time_ns == 0
    assert len(found["/cf1/camera/image"]) == 3


def test_a_camera_of_another_size_is_refused(tmp_path: Path) -> None:
    data = pack_image(Image(32, 24, "raw", foreign.make_raw_images(1)[0].tobytes()))
    with pytest.raises(SettingError, match="is 32x24 px, its camera 320x224"):
        read_samples(tmp_path / "a.cpx", data, Options(camera=AIDECK))


@pytest.mark.parametrize("encoding", ["raw", "jpeg"])
@pytest.mark.parametrize("camera", [None, AIDECK])
def test_full_sensor_images_are_cropped_to_the_network_s_size(
    encoding: Encoding, camera: Camera | None, tmp_path: Path
) -> None:
    raw = np.random.default_rng(0).integers(0, 256, (244, 324), np.uint8)
    payload = raw.tobytes() if encoding == "raw" else encode_jpeg(demosaic(raw))
    options = Options(camera=camera, size_px=(320, 224))
    found = read_samples(
        tmp_path / "a.cpx", pack_image(Image(324, 244, encoding, payload)), options
    )
    (image,) = found["/cf1/camera/image"]
    rgb = decode(image.fields["data"])
    assert rgb.shape == (224, 320, 3)
    if camera is not None and encoding == "raw":
        np.testing.assert_array_equal(rgb, demosaic(raw)[10:234, 2:322])


def test_a_cut_jpeg_is_left_out_and_the_others_stay(tmp_path: Path) -> None:
    jpeg = encode_jpeg(np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8))
    parts = [jpeg, jpeg[: len(jpeg) // 2], jpeg]
    data = b"".join(pack_image(Image(32, 24, "jpeg", part)) for part in parts)
    with count_left_out() as counted:
        found = read_samples(tmp_path / "a.cpx", data)
    assert [s.time_ns for s in found["/cf1/camera/image"]] == [0, 200_000_000]
    assert counted.counts == {"images that cannot be decoded": 1}


def test_jpegs_keep_their_bytes(tmp_path: Path) -> None:
    jpeg = encode_jpeg(np.full((24, 32, 3), 90, np.uint8))
    found = read_samples(tmp_path / "a.cpx", pack_image(Image(32, 24, "jpeg", jpeg)))
    (image,) = found["/cf1/camera/image"]
    assert (image.fields["format"], image.fields["data"]) == ("jpeg", jpeg)


# The clock wraps between the second and the third image, or between the first state and its image.
@pytest.mark.parametrize("start", [2**32 - 75_000, 2**32 + 1_000])
def test_the_camera_s_clock_and_the_robot_s_state_are_used(start: int, tmp_path: Path) -> None:
    data = b""
    for k, raw in enumerate(foreign.make_raw_images(4)):
        time = start + 50_000 * k
        state = RobotState(1000 + 50 * k, time - 4_000, (0.1 * k, 0.0, 0.7), (0.0, 0.5, 0.0))
        data += pack_image(Image(32, 24, "raw", raw.tobytes(), time, k, state), "streamer")
    found = read_samples(tmp_path / "a.cpx", data)
    assert np.diff([s.time_ns for s in found["/cf1/camera/image"]]).tolist() == [50_000_000] * 3
    heights = found["/cf1/height"]
    assert [s.fields["height_m"] for s in heights] == pytest.approx([0.7] * 4)
    assert heights[0].time_ns == found["/cf1/camera/image"][0].time_ns - 4_000_000
    assert found["/cf1/velocity"][0].fields["vy_mps"] == pytest.approx(0.5)
    assert found["/cf1/log/cpx_state"][2].fields["stateEstimate_x"] == pytest.approx(0.2)


def test_damaged_stream_keeps_whole_images_and_reports_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = pack_image(Image(32, 24, "raw", foreign.make_raw_images(1)[0].tobytes()))
    found = read_samples(tmp_path / "a.cpx", one * 2 + one[:12] + one * 2)
    assert len(found["/cf1/camera/image"]) >= 3
    assert "images that are broken" in capsys.readouterr().err


def test_file_without_a_picture_gives_one_line_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="has no whole image of a CPX stream"):
        read_samples(tmp_path / "a.cpx", b"\0" * 1000)
    assert not wifi_stream.can_read(tmp_path / "a.cpx")


@pytest.mark.parametrize("share", [0.5, 0.8, 0.99])
@pytest.mark.parametrize("layout", ["plain", "streamer"])
def test_truncated_stream_reports_the_broken_image(
    layout: Layout, share: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = [
        Image(32, 24, "raw", raw.tobytes(), 1_000_000 + 50_000 * k, k)
        for k, raw in enumerate(foreign.make_raw_images(3))
    ]
    whole = b"".join(pack_image(image, layout) for image in images)
    path = tmp_path / "flight.cpx"
    path.write_bytes(whole[: int(len(whole) * share)])
    found = wifi_stream.load_content(path, Options()).samples
    assert len([s for s in found if s.message == "CompressedImage"]) == int(3 * share)
    assert "left out: images that are broken or cut short: 1" in capsys.readouterr().err
    path.write_bytes(whole)
    list(wifi_stream.load_content(path, Options()).samples)
    assert not capsys.readouterr().err


def test_missing_camera_times_become_nominal_and_times_never_decrease() -> None:
    def convert(times_us: list[int | None], rate_hz: float = 10.0) -> list[int | None]:
        return wifi_stream._to_times_ns(times_us, Path("a.cpx"), Options(rate_hz=rate_hz))

    assert convert([5, 3, 9]) == [5000, 5000, 9000]
    assert convert([5, None, 9], 4.0) == [0, 250_000_000, 500_000_000]
    assert convert([0, 1]) == [0, 1000]
    with pytest.raises(SettingError, match=r"--rate-hz has no effect: a\.cpx has the times"):
        convert([0, 1], 4.0)


def test_a_camera_that_started_again_is_refused_with_its_image() -> None:
    times: list[int | None] = [*range(60_000_000, 61_000_000, 50_000), *range(0, 500_000, 50_000)]
    with pytest.raises(SourceError, match=r"a\.cpx: image 21: time goes back from 60\.95 s to 0 s"):
        wifi_stream._to_times_ns(times, Path("a.cpx"), Options())


@pytest.mark.parametrize(("garbage", "known"), [(1000, True), (65_000, True), (66_000, False)])
def test_stream_is_recognized_by_a_whole_image_near_its_start(
    garbage: int, known: bool, tmp_path: Path
) -> None:
    image = pack_image(Image(32, 24, "raw", foreign.make_raw_images(1)[0].tobytes()))
    path = tmp_path / "flight.cpx"
    path.write_bytes(bytes(garbage) + image * 2)
    assert wifi_stream.can_read(path) == known
    path.rename(tmp_path / "flight.txt")
    assert not wifi_stream.can_read(tmp_path / "flight.txt")


def test_yaw_rate_is_in_radians(tmp_path: Path) -> None:
    state = RobotState(1000, 5_000_000, (0.0, 0.0, 0.7), turning_radps=(0.1, 0.2, 0.5))
    raw = foreign.make_raw_images(1)[0].tobytes()
    data = pack_image(Image(32, 24, "raw", raw, 5_004_000, 1, state), "streamer")
    (attitude,) = read_samples(tmp_path / "a.cpx", data)["/cf1/attitude"]
    assert attitude.fields["yaw_rate_radps"] == pytest.approx(0.5)
    assert attitude.time_ns == 5_000_000_000


def test_a_state_is_logged_in_the_order_of_its_names(tmp_path: Path) -> None:
    state = RobotState(
        *(1000, 5_000_000, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
        turning_radps=tuple(np.radians((7.0, 8.0, 9.0)).tolist()),
    )
    raw = foreign.make_raw_images(1)[0].tobytes()
    data = pack_image(Image(32, 24, "raw", raw, 5_004_000, 1, state), "streamer")
    (logged,) = read_samples(tmp_path / "a.cpx", data)["/cf1/log/cpx_state"]
    values = [*(1, 2, 3), *(4, 5, 6), *(0, 0, 0, 1), *(7, 8, 9)]
    assert list(logged.fields.values()) == pytest.approx(values, abs=0.03)
    names = ("x", "y", "z", "vx", "vy", "vz", "qx", "qy", "qz", "qw")
    turns = [f"gyro_{axis}" for axis in "xyz"]
    assert list(logged.fields) == [*(f"stateEstimate_{name}" for name in names), *turns]
