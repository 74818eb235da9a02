"""The published LocaNet set: labels, frames and errors."""

from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.formats.base import Options
from dmrl.formats.published import locanet
from dmrl.geometry.frames import PUBLISHED_RENDER, Array, camera_from_horizontal, project
from dmrl.images.codec import encode_jpeg

POSITION = "./dataset/synImgs/{:04d}.jpg 0.1,-0.2 1.0,0.25,-0.125,0.0,0.1,2.0\n"
LABEL = "./dataset/synImgs/{:04d}.jpg 0.1,-0.2 132,137,1000,0\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a set of three images with one robot each; two are for training, one for testing."""
    inner = tmp_path / "set" / "synImgs"
    inner.mkdir(parents=True)
    jpeg = encode_jpeg(np.zeros((224, 320, 3), np.uint8))
    for k in range(3):
        (inner / f"{k:04d}.jpg").write_bytes(jpeg)
    (inner / "posLabel.txt").write_text("".join(POSITION.format(k) for k in range(3)))
    (inner / "boxLabel.txt").write_text(
        "".join(f"x/{k:04d}.jpg 120,118,141,133,0\n" for k in range(3))
    )
    (inner / "train.txt").write_text(LABEL.format(0) + LABEL.format(1))
    (inner / "test.txt").write_text(LABEL.format(2))
    return inner.parent


def test_a_picture_has_its_rows_from_every_file(folder: Path) -> None:
    first, _, last = locanet.load_images(folder)
    assert (first.path.name, first.number, first.split, last.split) == (
        "0000.jpg",
        0,
        "train",
        "test",
    )
    assert (first.roll_rad, first.pitch_rad) == (0.1, -0.2)
    np.testing.assert_array_equal(first.xyz_camera, [[1.0, 0.25, -0.125]])
    np.testing.assert_array_equal(first.attitude_rad, [[0.0, 0.1, 2.0]])
    np.testing.assert_array_equal(first.box_px, [[120, 117, 142, 133]])
    np.testing.assert_array_equal(first.published, [[132, 137, 1.0]])


def test_inner_folder_of_a_set_is_read_too(folder: Path) -> None:
    assert len(locanet.load_images(folder / "synImgs")) == 3
    assert locanet.can_read(folder) and locanet.can_read(folder / "synImgs")
    assert not locanet.can_read(folder.parent)


def test_true_and_published_labels_stand_side_by_side(folder: Path) -> None:
    content = locanet.load_content(folder)
    samples = list(content.samples)
    assert len(samples) == content.total
    assert content.split == {"train": [(0, 10**9)], "test": [(2 * 10**9, 2 * 10**9)]}
    label = next(s for s in samples if s.message == "PeerLabels").fields["peers"]
    true, published = label
    assert (true["peer"], true["source"]) == ("cf2", "truth")
    assert (true["u_px"], true["v_px"], true["depth_m"]) == (130.0, 127.0, 1.0)
    assert published == {**true, "u_px": 132, "v_px": 137, "source": "published"}


def test_the_robot_does_not_see_itself(folder: Path) -> None:
    peers = {
        s.topic
        for s in locanet.load_content(folder, Options(robot="cf2")).samples
        if s.message == "PeerPosition"
    }
    assert peers == {"/cf2/peer/cf3/truth"}


def test_the_position_is_turned_by_the_whole_published_rotation(folder: Path) -> None:
    # The first two results were derived by hand. With the right side down, a point ahead and to
    # the left is higher than the camera. With the nose down, a point straight ahead is lower.
    inner = folder / "synImgs"
    lines = ["0.3,0.0 1,1,0,0,0,0", "0.0,0.3 1,0,0,0,0,0", "0.3,-0.2 1,0.5,0.2,0,0,0"]
    text = "".join(f"p/{k:04d}.jpg {line}\n" for k, line in enumerate(lines))
    (inner / "posLabel.txt").write_text(text)
    samples = locanet.load_content(folder).samples
    xyz = [[s.fields[k] for k in "xyz"] for s in samples if s.message == "PeerPosition"]
    np.testing.assert_allclose(xyz[0], [1, np.cos(0.3), np.sin(0.3)])
    np.testing.assert_allclose(xyz[1], [np.cos(0.3), 0, -np.sin(0.3)], atol=1e-15)
    whole = _rx(0.3) @ _ry(-0.2)
    height = (whole @ [1, 0.5, 0.2])[2]
    assert xyz[2][2] == pytest.approx(height)
    assert np.linalg.norm(xyz[2]) == pytest.approx(np.linalg.norm([1, 0.5, 0.2]))


def test_the_attitude_differs_from_the_published_one_by_a_yaw_only() -> None:
    roll, pitch = 0.3, -0.25
    tilt = camera_from_horizontal(*locanet.to_attitude_zyx(roll, pitch)).T
    yaw = _rx(roll) @ _ry(pitch) @ tilt.T
    np.testing.assert_allclose(yaw[2], [0, 0, 1], atol=1e-15)


@pytest.mark.heavy
def test_published_set_is_complete(data: Path) -> None:
    images = locanet.load_images(data / "locanet-synthetic")
    assert [i.number for i in images] == list(range(882))
    splits = [i.split for i in images]
    assert (splits.count("train"), splits.count("test")) == (784, 98)
    several = locanet.load_images(data / "locanet-multi")
    assert {len(i.xyz_camera) for i in several} == {1, 2, 3, 4}
    assert {i.split for i in several} == {None}
    assert sum(len(i.published) for i in several) == 0


@pytest.mark.heavy
def test_true_projections_lie_in_the_middle_of_the_boxes(data: Path) -> None:
    images = locanet.load_images(data / "locanet-synthetic")
    edges = PUBLISHED_RENDER.width_px, PUBLISHED_RENDER.height_px
    whole = [i for i in images if (i.box_px[0, :2] > 0).all() and (i.box_px[0, 2:] < edges).all()]
    box = np.concatenate([i.box_px for i in whole])
    middle = (box[:, :2] + box[:, 2:]) / 2
    uv, _ = project(
        np.concatenate([i.xyz_camera for i in whole]), PUBLISHED_RENDER.image_from_optical
    )
    published = np.concatenate([i.published[:, :2] for i in whole])
    assert np.abs(np.median(uv - middle, axis=0)).max() < 0.75
    np.testing.assert_allclose(np.median(published - middle, axis=0), (2, 10.5), atol=0.6)


@pytest.mark.heavy
def test_only_the_unnegated_attitudes_fit_the_outlines(data: Path) -> None:
    """Among all signs of the angles, only the stored ones fit the edges of the boxes."""
    images = locanet.load_images(data / "locanet-synthetic")
    edges = PUBLISHED_RENDER.width_px, PUBLISHED_RENDER.height_px
    whole = [i for i in images if (i.box_px[0, :2] > 0).all() and (i.box_px[0, 2:] < edges).all()]
    errors = {
        signs: np.median([_box_error(i, signs) for i in whole])
        for signs in product((1, -1), repeat=4)
    }
    best, second = sorted(errors, key=lambda signs: errors[signs])[:2]
    assert best == (1, 1, 1, 1)
    assert errors[best] < 0.7
    assert errors[second] > 1.5 * errors[best]


def _box_error(item: locanet.LocanetImage, signs: tuple[int, ...]) -> float:
    """Return the median error of a box's four edges, pixels, for these signs of the angles.

    The edges are those of a rough outline of the published robot model.
    """
    roll, pitch, yaw = item.attitude_rad[0]
    camera = _rx(signs[0] * item.roll_rad) @ _ry(signs[1] * item.pitch_rad)
    robot = _rx(signs[2] * roll) @ _rz(yaw) @ _ry(signs[3] * pitch)
    uv, _ = project(
        OUTLINE @ (camera.T @ robot).T + item.xyz_camera, PUBLISHED_RENDER.image_from_optical
    )
    return float(np.median(np.abs(np.concatenate([uv.min(0), uv.max(0)]) - item.box_px[0])))


def _make_outline() -> Array:
    """Return (N, 3) points on rotors, feet and body of a Crazyflie of twice its size, metres."""
    points = [[x, y, -0.019] for x in (-0.04, 0.04) for y in (-0.04, 0.04)]
    for arm in np.pi / 4 + np.arange(4) * np.pi / 2:
        x, y = 0.107 * np.cos(arm), 0.107 * np.sin(arm)
        points += [
            [x + 0.021 * np.cos(a), y + 0.021 * np.sin(a), 0.034] for a in np.arange(12) * np.pi / 6
        ]
        points.append([x, y, -0.03])
    return np.array(points)


def _rx(a: float) -> Array:
    """Return the (3, 3) rotation about x, radians."""
    return np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])


def _ry(a: float) -> Array:
    """Return the (3, 3) rotation about y, radians."""
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


def _rz(a: float) -> Array:
    """Return the (3, 3) rotation about z, radians."""
    return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])


OUTLINE = _make_outline()


def _spoil(name: str, line: int, text: str) -> Callable[[Path], None]:
    """Return a function that replaces a line, counted from 1, of a file of the set."""

    def spoil(inner: Path) -> None:
        lines = (inner / name).read_text().splitlines()
        lines[line - 1] = text
        (inner / name).write_text("\n".join(lines) + "\n")

    return spoil


def _remove(name: str) -> Callable[[Path], None]:
    """Return a function that removes a file of the set."""
    return lambda inner: (inner / name).unlink()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_remove("posLabel.txt"), r"no posLabel\.txt in .*synImgs\. Pass the folder"),
        (_remove("0001.jpg"), r"posLabel\.txt:2: no image .*0001\.jpg\. Restore it"),
        (_spoil("posLabel.txt", 2, "p/0001.jpg 0,0 1,2,x,0,0,0"), r"posLabel\.txt:2: .*'x'"),
        (_spoil("posLabel.txt", 2, "p/0001.jpg 0,0 1,2,3"), r"posLabel\.txt:2: not path"),
        (_spoil("posLabel.txt", 2, "p/0001.jpg 0,0 1,2,nan,0,0,0"), r":2: not .*finite"),
        (_spoil("posLabel.txt", 2, "p/0001.jpg"), r"posLabel\.txt:2: not path"),
        (_spoil("posLabel.txt", 2, ""), r"posLabel\.txt:2: not path"),
        (
            _spoil("posLabel.txt", 2, POSITION.format(0).strip()),
            r":2: 0000\.jpg has a line already",
        ),
        (_spoil("posLabel.txt", 2, "0001.jpg 0,0 -1,0,0,0,0,0"), r":2: .*behind the camera"),
        (_spoil("boxLabel.txt", 3, "x/0009.jpg 1,2,3,4,0"), r"posLabel\.txt:3: no line for 0002"),
        (
            _spoil("train.txt", 2, LABEL.format(2).strip()),
            r"test\.txt:1: 0002\.jpg is in train\.txt too",
        ),
        (
            _spoil("train.txt", 2, "0001.jpg 0,0 1,2,3,0 1,2,3,0"),
            r"train\.txt:2: 2 robots, but 1 at .*posLabel\.txt:2",
        ),
    ],
)
def test_faults_name_file_and_line(
    folder: Path, spoil: Callable[[Path], None], message: str
) -> None:
    spoil(folder / "synImgs")
    with pytest.raises(SourceError, match=message) as e:
        locanet.load_images(folder)
    assert "\n" not in str(e.value)


def test_a_picture_that_is_cut_or_of_another_size_is_named(folder: Path) -> None:
    path = folder / "synImgs" / "0001.jpg"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(SourceError, match=r"0001\.jpg cannot be decoded"):
        list(locanet.load_content(folder).samples)
    path.write_bytes(encode_jpeg(np.zeros((240, 320, 3), np.uint8)))
    with pytest.raises(SourceError, match=r"0001\.jpg is 320x240, the set is 320x224"):
        list(locanet.load_content(folder).samples)


def test_two_sets_in_one_folder_are_not_mixed(folder: Path) -> None:
    (folder / "synImgsMulti").mkdir()
    with pytest.raises(SourceError, match="has two sets"):
        locanet.load_images(folder)


def test_set_without_boxes_and_splits_is_read(folder: Path) -> None:
    for name in ("boxLabel.txt", "train.txt", "test.txt"):
        (folder / "synImgs" / name).unlink()
        assert len(locanet.load_images(folder)) == 3
    first = locanet.load_images(folder)[0]
    assert (first.split, len(first.published)) == (None, 0)


def test_peers_are_numbered_from_two_without_the_robot_itself() -> None:
    assert locanet._name_peers("cf1", 3) == ["cf2", "cf3", "cf4"]
    assert locanet._name_peers("cf3", 3) == ["cf2", "cf4", "cf5"]
    assert locanet._name_peers("cf9", 0) == []


def test_boxes_end_at_the_picture_s_edges() -> None:
    found = locanet._to_box_px(np.array([[-5.0, -4, 319, 224, 0], [0, 1, 400, 300, 0]]))
    assert found.tolist() == [[0, 0, 320, 224], [0, 0, 320, 224]]


def test_published_two_angle_attitude_is_converted_to_zyx() -> None:
    for roll, pitch in ((0.3, 0.0), (0.0, -0.2), (0.3, -0.2), (-0.1, 0.25)):
        found = locanet.to_attitude_zyx(roll, pitch)
        up = (_rx(roll) @ _ry(pitch)).T @ [0, 0, 1]  # the vertical in the camera frame
        assert camera_from_horizontal(*found) @ [0, 0, 1] == pytest.approx(up)


def test_image_number_sets_its_time_and_rows(folder: Path) -> None:
    inner = folder / "synImgs"
    jpeg = (inner / "0000.jpg").read_bytes()
    for path in inner.iterdir():
        path.unlink()
    for number in (12, 7):
        (inner / f"{number:04d}.jpg").write_bytes(jpeg)
    (inner / "posLabel.txt").write_text(
        "p/0012.jpg 0.2,0.1 1,0.1,0.2,0,0,0 2,-0.3,0.4,0,0,0\np/0007.jpg 0,0 3,0,0,0,0,0\n"
    )
    (inner / "boxLabel.txt").write_text(
        "p/0007.jpg 1,3,5,7,0\np/0012.jpg 10,20,30,40,0 50,60,70,80,0\n"
    )
    (inner / "train.txt").write_text("p/0012.jpg 0.2,0.1 1,2,3000,0 4,5,6000,0\n")
    content = locanet.load_content(folder, Options(robot="cf2"))
    first, *rest = content.samples
    assert (first.topic, first.time_ns) == ("/cf2/camera/calibration", 7 * 10**9)
    assert content.total == 1 + len(rest) == 10
    assert [s.time_ns for s in rest] == [7 * 10**9] * 4 + [12 * 10**9] * 5
    topics = ["camera/image", "labels", "attitude", "peer/cf1/truth", "peer/cf3/truth"]
    assert {s.topic for s in rest} <= {f"/cf2/{t}" for t in [*topics, "peer/cf4/truth"]}
    labels = [s for s in rest if s.message == "PeerLabels"]
    assert [s.fields["sources"] for s in labels] == [["truth"], ["published", "truth"]]
    (alone,) = labels[0].fields["peers"]
    assert (alone["u_px"], alone["v_px"], alone["depth_m"]) == pytest.approx(
        (PUBLISHED_RENDER.cx_px, PUBLISHED_RENDER.cy_px, 3)
    )
    assert alone["box_px"] == [1, 2, 6, 7]
    one, told, other, told_too = labels[1].fields["peers"]
    assert one["peer"] == told["peer"] != other["peer"] == told_too["peer"]
    assert (one["box_px"], other["box_px"]) == ([10, 19, 31, 40], [50, 59, 71, 80])
    assert [told[n] for n in ("u_px", "v_px", "depth_m")] == [1, 2, 3]
    assert [told_too[n] for n in ("u_px", "v_px", "depth_m")] == [4, 5, 6]
    truth = [s for s in rest if s.message == "PeerPosition"]
    assert all(s.fields["covariance"] == [0.0] * 9 for s in truth)
    assert all(s.fields["frame_id"] == "cf2/horizontal" for s in truth)
    tilt = [s.fields for s in rest if s.message == "Attitude"][1]
    wanted = camera_from_horizontal(tilt["roll_rad"], tilt["pitch_rad"]).T @ [2, -0.3, 0.4]
    assert [truth[2].fields[n] for n in "xyz"] == pytest.approx(wanted)


def test_robot_at_the_camera_position_is_refused(folder: Path) -> None:
    inner = folder / "synImgs"
    for x, fits in (("0.001", True), ("0", False)):
        _spoil("posLabel.txt", 1, f"p/0000.jpg 0.1,-0.2 {x},0,0,0,0,0")(inner)
        if fits:
            assert locanet.load_images(folder)[0].xyz_camera[0, 0] == 0.001
        else:
            with pytest.raises(SourceError, match="behind the camera"):
                locanet.load_images(folder)


def test_empty_list_and_unnumbered_name_are_reported(folder: Path) -> None:
    inner = folder / "synImgs"
    (inner / "a7.jpg").write_bytes((inner / "0000.jpg").read_bytes())
    _spoil("posLabel.txt", 1, POSITION.format(0).replace("0000", "a7").strip())(inner)
    with pytest.raises(SourceError, match=r"a7\.jpg is not named by its number"):
        locanet.load_images(folder)
    (inner / "posLabel.txt").write_text("")
    with pytest.raises(SourceError, match="is empty"):
        locanet.load_images(folder)
