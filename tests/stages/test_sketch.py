"""`dmrl sketch`: labelled images without Blender."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import OutputError, SettingError
from dmrl.geometry.frames import AIDECK_PINHOLE
from dmrl.images.codec import decode
from dmrl.recording import SPLIT_METADATA, read, read_summary
from dmrl.simulation.drawn_pictures import draw_picture
from dmrl.stages import convert
from dmrl.stages.sketch import Settings, run

SMALL = Settings(images=12, seed=5, empty_share=0.3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of twelve sketched images. Tests must not change it."""
    out = tmp_path_factory.mktemp("sketch") / "sketch"
    run(out, SMALL)
    return out


@pytest.mark.heavy
def test_every_image_is_labelled_including_empty_ones(folder: Path) -> None:
    names = [path.name for path in sorted(folder.glob("*.png"))]
    assert names == [f"{k:06d}.png" for k in range(12)]
    with (folder / "labels.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert sorted({row["file"] for row in rows}) == names
    empty = {row["file"] for row in rows if not row["peer"]}
    drawn = {f"{k:06d}.png" for k in range(12) if len(draw_picture(SMALL, k).depth_m)}
    assert empty == set(names) - drawn != set()
    assert [row["split"] for row in rows if row["file"] >= names[10]].count("train") == 0


@pytest.mark.heavy
def test_converted_labels_equal_the_drawn_ones(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "sketch.mcap"
    counts = convert.run(folder, out, convert.Settings())
    assert counts == {"/cf1/camera/calibration": 1, "/cf1/camera/image": 12, "/cf1/labels": 12}
    pictures = read(out, "/cf1/camera/image")
    labels = read(out, "/cf1/labels")
    for k, (picture, label) in enumerate(zip(pictures, labels, strict=True)):
        drawn = draw_picture(SMALL, k)
        assert picture.time_ns == label.time_ns == k * 100_000_000
        np.testing.assert_array_equal(decode(picture.message.data), drawn.rgb)
        peers = label.message.peers
        assert [p.peer for p in peers] == [f"cf{i + 2}" for i in range(len(drawn.depth_m))]
        got = np.array([[p.u_px, p.v_px, p.depth_m, *p.box_px] for p in peers]).reshape(-1, 7)
        want = np.column_stack([drawn.uv_px, drawn.depth_m, drawn.box_px])
        np.testing.assert_allclose(got, want, atol=1e-4)
        assert {p.source for p in peers} <= {"truth"}
    (calibration,) = read(out, "/cf1/camera/calibration")
    np.testing.assert_array_equal(
        np.reshape(calibration.message.K, (3, 3)), AIDECK_PINHOLE.image_from_optical
    )
    (split,) = read_summary(out).metadata[SPLIT_METADATA]
    assert json.loads(split["test"]) == [[1_000_000_000, 1_100_000_000]]


@pytest.mark.heavy
def test_the_ancestry_reaches_back_to_the_seed(folder: Path, tmp_path: Path) -> None:
    convert.run(folder, tmp_path / "sketch.mcap", convert.Settings())
    made = read_summary(tmp_path / "sketch.mcap").provenance
    assert made is not None
    source = made.inputs[0].provenance
    assert source is not None
    assert (source.stage, source.seed) == ("sketch", 5)


@pytest.mark.heavy
def test_the_same_seed_draws_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    run(tmp_path / "again", SMALL)
    for path in sorted(folder.iterdir()):
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes()


def test_a_picture_does_not_depend_on_how_many_are_drawn(folder: Path) -> None:
    alone = draw_picture(Settings(images=1, seed=5, empty_share=0.3), 7)
    np.testing.assert_array_equal(alone.rgb, decode((folder / "000007.png").read_bytes()))


@pytest.mark.parametrize(
    "settings",
    [
        Settings(images=0),
        Settings(robots_max=0),
        Settings(seed=-1),
        Settings(empty_share=1.5),
        Settings(test_share=-0.1),
    ],
)
def test_settings_out_of_range_are_refused(tmp_path: Path, settings: Settings) -> None:
    with pytest.raises(SettingError, match=r"--.*\. (Change|Choose)"):
        run(tmp_path / "sketch", settings)
    assert list(tmp_path.iterdir()) == []


def test_folders_are_never_overwritten(folder: Path) -> None:
    with pytest.raises(OutputError, match="never overwritten"):
        run(folder, SMALL)
