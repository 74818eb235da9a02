"""Folders of images and labels become samples."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SettingError, SourceError
from dmrl.formats.base import Options
from dmrl.formats.files import image_folder
from dmrl.geometry.camera_file import format_camera
from dmrl.geometry.frames import AIDECK, project
from dmrl.images.bayer import demosaic
from dmrl.images.codec import decode, encode_png
from dmrl.samples.sample import Sample
from dmrl.terminal.left_out import count_left_out

HEADER = "file,peer,u_px,v_px,depth_m\n"


def read_samples(folder: Path, kind: str, options: Options | None = None) -> list[Sample]:
    """Return the samples of one message type."""
    found = image_folder.load_content(folder, options or Options()).samples
    return [sample for sample in found if sample.message == kind]


def test_png_and_jpeg_keep_their_bytes_and_others_their_pixels(folder: Path) -> None:
    png, jpeg, ppm = read_samples(folder, "CompressedImage")
    assert png.fields["data"] == (folder / "a.png").read_bytes()
    assert (jpeg.fields["format"], jpeg.fields["data"]) == (
        "jpeg",
        (folder / "b.JPG").read_bytes(),
    )
    assert ppm.fields["format"] == "png"
    np.testing.assert_array_equal(decode(ppm.fields["data"]), decode(png.fields["data"]))


def test_names_that_are_no_times_get_a_nominal_rate(folder: Path) -> None:
    times = [s.time_ns for s in read_samples(folder, "CompressedImage", Options(rate_hz=30))]
    assert times == [0, 33_333_333, 66_666_667]


def test_names_of_twelve_digits_are_times(folder: Path) -> None:
    times = (1_700_000_000_000_000_000, 1_600_000_000_000_000_000, 999_999_999_999)
    for path, time_ns in zip(sorted(folder.glob("[abc].*")), times, strict=True):
        path.rename(folder / f"{time_ns}{path.suffix}")
    assert [s.time_ns for s in read_samples(folder, "CompressedImage")] == sorted(times)


def test_unlabelled_empty_and_labelled_images_differ(folder: Path) -> None:
    (folder / "labels.csv").write_text(
        "file,peer,u_px,v_px,depth_m,left_px,top_px,right_px,bottom_px,visible_share,source,split\n"
        "a.png,cf2,10.5,20,0.8,5,15,16,25,0.5,truth,train\n"
        "a.png,cf3,70,20,1.5,,,,,,,train\n"
        "c.ppm,,,,,,,,,,,test\n"
    )
    content = image_folder.load_content(folder, Options())
    found = [s for s in content.samples if s.message == "PeerLabels"]
    assert [s.time_ns for s in found] == [0, 200_000_000]
    first, second = found[0].fields["peers"]
    assert first == {
        "peer": "cf2",
        "u_px": 10.5,
        "v_px": 20.0,
        "depth_m": 0.8,
        "visible_share": 0.5,
        "source": "truth",
        "sigma_u_px": 0.0,
        "sigma_v_px": 0.0,
        "sigma_depth_m": 0.0,
        "box_px": [5, 15, 16, 25],
    }
    assert (second["source"], second["box_px"]) == ("hand", [])
    assert found[1].fields["peers"] == []
    assert content.split == {"train": [(0, 0)], "test": [(200_000_000, 200_000_000)]}
    assert content.total == 5


def test_labels_boxes_and_camera_follow_the_crop(folder: Path) -> None:
    # The crop keeps the middle 48 x 48 pixels of 64 x 48, from column 8, and scales them by 40/48.
    (folder / "labels.csv").write_text(
        "file,peer,u_px,v_px,depth_m,left_px,top_px,right_px,bottom_px,sigma_u_px,sigma_depth_m\n"
        "a.png,cf2,32,12,0.8,4,6,20,18,6,0.3\n"
        "b.JPG,cf2,2,12,0.8,0,6,7,18,,\n"
    )
    camera = replace(AIDECK, width_px=64, height_px=48, cx_px=30.0, cy_px=20.0)
    options = Options(camera=camera, size_px=(40, 40))
    one, other = (s.fields["peers"][0] for s in read_samples(folder, "PeerLabels", options))
    assert (one["u_px"], one["v_px"], one["sigma_u_px"]) == pytest.approx((20, 10, 5))
    assert (one["depth_m"], one["sigma_depth_m"]) == (0.8, 0.3)
    assert one["box_px"] == pytest.approx([0, 5, 10, 15])
    assert other["u_px"] < 0 and other["box_px"] == []
    assert {
        decode(s.fields["data"]).shape for s in read_samples(folder, "CompressedImage", options)
    } == {(40, 40, 3)}
    (calibration,) = read_samples(folder, "CameraCalibration", options)
    point = np.array([[2.0, 0.1, 0.2]])
    before, _ = project(point, camera.image_from_optical)
    after, _ = project(point, np.reshape(calibration.fields["K"], (3, 3)))
    np.testing.assert_allclose(after, (before - (8, 0)) * 40 / 48)
    assert (calibration.fields["width"], calibration.fields["height"]) == (40, 40)
    assert calibration.fields["D"] == list(AIDECK.distortion)


def test_crop_and_labels_agree(tmp_path: Path) -> None:
    rgb = np.zeros((300, 500, 3), np.uint8)
    rgb[100:120, 350:380] = 255
    (tmp_path / "a.png").write_bytes(encode_png(rgb))
    (tmp_path / "labels.csv").write_text(HEADER + "a.png,cf2,365,110,1\n")
    options = Options(size_px=(320, 224))
    (label,) = read_samples(tmp_path, "PeerLabels", options)
    (picture,) = read_samples(tmp_path, "CompressedImage", options)
    bright = np.argwhere(decode(picture.fields["data"])[..., 0] > 127)
    v_px, u_px = (bright.min(0) + bright.max(0) + 1) / 2
    peer = label.fields["peers"][0]
    assert (peer["u_px"], peer["v_px"]) == pytest.approx((u_px, v_px), abs=0.6)


def _write_labels(text: str) -> Callable[[Path], None]:
    """Return a function that writes a text to labels.csv of a folder."""
    return lambda folder: (folder / "labels.csv").write_text(text) and None


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_write_labels(HEADER + "a.pgn,cf2,1,2,3\n"), r"labels\.csv:2: .*'a\.pgn' .*mean a\.png\?"),
        (_write_labels(HEADER + "zzzz,cf2,1,2,3\n"), r"labels\.csv:2: .*Add the image, or delete"),
        (
            _write_labels(HEADER + "\na.png,cf2,1,x,3\n"),
            r"labels\.csv:3: v_px is 'x', not a number",
        ),
        (_write_labels(HEADER + "a.png,cf2,1,nan,3\n"), r"v_px is 'nan', not a number"),
        (_write_labels(HEADER + "a.png,cf2,1,2,0\n"), r"labels\.csv:2: depth_m is 0"),
        (_write_labels(HEADER + "a.png,cf2,1,2\n"), r"labels\.csv:2: not as many cells"),
        (_write_labels(HEADER + "a.png,cf2,1,2,3,4\n"), r"labels\.csv:2: not as many cells"),
        (_write_labels(HEADER + "a.png,,1,2,3\n"), r"labels\.csv:2: u_px without a peer"),
        (_write_labels(HEADER + "a.png,cf2,1,2,3\na.png,,,,\n"), r"labels\.csv:3: .*empty peer"),
        (
            _write_labels(HEADER + "a.png,cf2,1,2,3\n" * 2),
            r"labels\.csv:3: .*cf2 from hand already",
        ),
        (_write_labels("file,peer,u,v_px,depth_m\n"), r"labels\.csv:1: unknown column 'u'"),
        (_write_labels("file,u_px,v_px\n"), r"labels\.csv:1: no column peer"),
        (_write_labels(HEADER.strip() + ",peer\n"), r"labels\.csv:1: a column appears twice"),
        (
            _write_labels(HEADER.strip() + ",left_px\na.png,cf2,1,2,3,4\n"),
            r"labels\.csv:2: not a box",
        ),
        (
            _write_labels(HEADER.strip() + ",visible_share\na.png,cf2,1,2,3,40\n"),
            r":2: visible_share is 40",
        ),
        (
            _write_labels(HEADER.strip() + ",sigma_u_px\na.png,cf2,1,2,3,-1\n"),
            r":2: a sigma is negative",
        ),
        (
            _write_labels(HEADER.strip() + ",split\na.png,cf2,1,2,3,test\na.png,cf3,1,2,3,\n"),
            r"labels\.csv:3: a\.png is in split none and in test",
        ),
        (_write_labels(""), r"labels\.csv:1: no column file, peer"),
        (lambda folder: (folder / "labels.csv").write_bytes(b"\xff\xfe\0") and None, "not a CSV"),
        (lambda folder: (folder / "123456789012.png").write_bytes(b"") and None, "by its time"),
    ],
)
def test_faults_name_the_file_and_the_way_out(
    folder: Path, spoil: Callable[[Path], None], message: str
) -> None:
    spoil(folder)
    with pytest.raises(SourceError, match=message) as e:
        list(image_folder.load_content(folder, Options()).samples)
    assert "\n" not in str(e.value)


def test_a_label_file_that_was_named_must_be_there(folder: Path) -> None:
    with pytest.raises(SourceError, match=r"no label file .*mine\.csv\. Pass another"):
        image_folder.load_content(folder, Options(labels=folder / "mine.csv"))


def test_a_camera_of_another_size_is_refused(folder: Path) -> None:
    with pytest.raises(SettingError, match=r"a\.png is 64x48 px, its camera 320x224\."):
        read_samples(folder, "CompressedImage", Options(camera=AIDECK))


def test_two_pictures_of_one_time_are_refused(tmp_path: Path) -> None:
    for name in ("0123456789012.png", "123456789012.png"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(SourceError, match="have the same time"):
        image_folder.list_images(tmp_path, 10.0)


def test_real_frames_convert(data: Path) -> None:
    found = read_samples(data / "aideck-frames", "CompressedImage", Options(camera=AIDECK))
    paths = sorted((data / "aideck-frames").glob("*.ppm"))
    for path, sample in zip(paths, found, strict=True):
        np.testing.assert_array_equal(decode(sample.fields["data"]), decode(path.read_bytes()))


def test_firmware_text_file_becomes_messages_and_labels(folder: Path) -> None:
    lines = ["deck/a.png 1.5 -2.0 1.0 0.2 -0.1 1.03", "c.ppm,0,0,2,0,0,2", ""]
    (folder / "label.txt").write_text("\n".join(lines))
    camera = replace(AIDECK, width_px=64, height_px=48, cx_px=32, cy_px=24, fx_px=40, fy_px=40)
    found = read_samples(folder, "PeerPosition")
    assert [[s.fields[axis] for axis in "xyz"] for s in found] == [[1, 0.2, -0.1], [2, 0, 0]]
    attitude = read_samples(folder, "Attitude")[0].fields
    assert attitude["pitch_rad"] == pytest.approx(np.radians(2.0))  # logged positive nose up
    assert read_samples(folder, "PeerLabels") == []  # no camera
    first, last = read_samples(folder, "PeerLabels", Options(camera=camera))
    assert last.fields["peers"][0]["u_px"] == pytest.approx(32)
    assert first.fields["peers"][0]["source"] == "estimate"


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("a.png 1 2 3", r"label\.txt:1: not an image and roll pitch x y z d"),
        ("d.png 1 2 3 4 5 6", r"label\.txt:1: no image d\.png"),
    ],
)
def test_a_wrong_line_of_the_firmware_s_text_is_named(folder: Path, line: str, text: str) -> None:
    (folder / "label.txt").write_text(line + "\n")
    with pytest.raises(SourceError, match=text):
        read_samples(folder, "PeerPosition")


def test_firmware_text_file_without_camera_is_reported(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "label.txt").write_text("a.png 1 2 1.0 0.1 0.0 1.0\n")
    assert not read_samples(folder, "PeerLabels")
    assert "label.txt gives no labels without a camera. Pass: --camera" in capsys.readouterr().err


def test_raw_pictures_get_their_colours(tmp_path: Path) -> None:
    raw = np.random.default_rng(3).integers(0, 256, (24, 32), np.uint8)
    (tmp_path / "a.pgm").write_bytes(b"P5\n32 24\n255\n" + raw.tobytes())
    (grey,) = read_samples(tmp_path, "CompressedImage")
    np.testing.assert_array_equal(decode(grey.fields["data"])[..., 0], raw)
    (colour,) = read_samples(tmp_path, "CompressedImage", Options(raw=True))
    np.testing.assert_array_equal(decode(colour.fields["data"]), demosaic(raw))


def test_coloured_pictures_are_not_raw(folder: Path) -> None:
    with pytest.raises(SettingError, match=r"has colours already.* Remove --raw"):
        read_samples(folder, "CompressedImage", Options(raw=True))


@pytest.mark.heavy
def test_full_sensor_images_are_cropped_to_the_camera(tmp_path: Path) -> None:
    whole = np.random.default_rng(0).integers(0, 256, (244, 324, 3), np.uint8)
    (tmp_path / "a.png").write_bytes(encode_png(whole))
    (tmp_path / "labels.csv").write_text("file,peer,u_px,v_px,depth_m\na.png,cf2,102,110,1\n")
    for size_px in (None, (320, 224)):
        options = Options(camera=AIDECK, size_px=size_px)
        (picture,) = read_samples(tmp_path, "CompressedImage", options)
        np.testing.assert_array_equal(decode(picture.fields["data"]), whole[10:234, 2:322])
        (camera,) = read_samples(tmp_path, "CameraCalibration", options)
        assert camera.fields["K"][2] == AIDECK.cx_px
        (label,) = read_samples(tmp_path, "PeerLabels", options)
        assert (label.fields["peers"][0]["u_px"], label.fields["peers"][0]["v_px"]) == (100, 100)


@pytest.mark.parametrize(
    ("size_px", "wanted", "label_px"),
    [
        ((160, 112), (AIDECK.fx_px / 2, AIDECK.cx_px / 2, AIDECK.cy_px / 2), (50, 50)),
        ((324, 244), (AIDECK.fx_px, AIDECK.cx_px + 2, AIDECK.cy_px + 10), (102, 110)),
    ],
)
def test_full_sensor_images_scale_the_camera_matrix(
    tmp_path: Path,
    size_px: tuple[int, int],
    wanted: tuple[float, float, float],
    label_px: tuple[int, int],
) -> None:
    whole = np.random.default_rng(0).integers(0, 256, (244, 324, 3), np.uint8)
    (tmp_path / "a.png").write_bytes(encode_png(whole))
    (tmp_path / "labels.csv").write_text("file,peer,u_px,v_px,depth_m\na.png,cf2,102,110,1\n")
    options = Options(camera=AIDECK, size_px=size_px)
    (picture,) = read_samples(tmp_path, "CompressedImage", options)
    assert decode(picture.fields["data"]).shape == (size_px[1], size_px[0], 3)
    (camera,) = read_samples(tmp_path, "CameraCalibration", options)
    assert [camera.fields["K"][k] for k in (0, 2, 5)] == pytest.approx(wanted)
    assert (camera.fields["width"], camera.fields["height"]) == size_px
    (label,) = read_samples(tmp_path, "PeerLabels", options)
    assert (label.fields["peers"][0]["u_px"], label.fields["peers"][0]["v_px"]) == label_px


def test_expected_message_count_is_exact(folder: Path) -> None:
    (folder / "labels.csv").write_text(HEADER + "a.png,cf2,10,20,0.8\na.png,cf3,10,20,0.8\n")
    camera = replace(AIDECK, width_px=64, height_px=48)
    for options, more in ((Options(), 0), (Options(camera=camera), 1)):
        content = image_folder.load_content(folder, options)
        assert content.total == len(list(content.samples)) == 3 + 1 + more


def test_given_camera_precedes_calibration_file(folder: Path) -> None:
    near = replace(AIDECK, width_px=64, height_px=48, cx_px=30.0)
    (folder / "calibration.toml").write_text(format_camera(near))
    for camera, cx_px in ((None, 30.0), (replace(near, cx_px=31.0), 31.0)):
        (found,) = read_samples(folder, "CameraCalibration", Options(camera=camera))
        assert found.fields["K"][2] == cx_px
        assert found.time_ns == 0


@pytest.mark.parametrize("pitch_rad", [0.0, 0.1])
def test_a_mount_that_a_recording_does_not_hold_is_named(
    pitch_rad: float, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = replace(AIDECK, width_px=64, height_px=48, mount_rad=(0.0, pitch_rad, 0.0))
    read_samples(folder, "CameraCalibration", Options(camera=camera))
    assert ("cf1: a recording does not hold the mount" in capsys.readouterr().err) == bool(
        pitch_rad
    )


@pytest.mark.parametrize(("labelled", "camera", "said"), [(0, 0, 1), (1, 0, 0), (0, 1, 0)])
def test_missing_camera_is_reported_only_if_labels_depend_on_it(
    labelled: int, camera: int, said: int, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "label.txt").write_text("a.png 1 2 1.0 0.1 0.0 1.0\n")
    if labelled:
        (folder / "labels.csv").write_text(HEADER + "a.png,cf2,10,20,0.8\n")
    known = replace(AIDECK, width_px=64, height_px=48) if camera else None
    assert len(read_samples(folder, "PeerLabels", Options(camera=known))) == max(labelled, camera)
    assert ("gives no labels without a camera" in capsys.readouterr().err) == bool(said)


@pytest.mark.parametrize("size", [(3, 8), (8, 3), (4, 4)])
def test_raw_pictures_are_of_four_by_four_pixels_at_least(
    size: tuple[int, int], tmp_path: Path
) -> None:
    height, width = size
    head = f"P5\n{width} {height}\n255\n".encode()
    (tmp_path / "a.pgm").write_bytes(head + bytes(width * height))
    if size == (4, 4):
        assert read_samples(tmp_path, "CompressedImage", Options(raw=True))
        return
    with count_left_out() as counted:
        assert not read_samples(tmp_path, "CompressedImage", Options(raw=True))
    assert counted.counts == {"images that cannot be decoded": 1}
