"""Logged data of the layout ``dataset``, which sorts rows by their error."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dmrl import topics
from dmrl.datasets import open_dataset
from dmrl.errors import DatasetError, RecordingError, SettingError
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter
from dmrl.recording import build_provenance as made_by
from dmrl.stages import dataset as dataset_stage
from dmrl.viewer import Settings, save

from .rrd import count_rows, read_column, read_panel_names

Make = Callable[..., Path]
STEP_NS = 100_000_000
OFF_PX = (3.0, 30.0, 1.0, 10.0)
"""Errors of the detections in the four images with a peer, pixels."""


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return five labelled images; the last shows no peer."""
    path = tmp_path_factory.mktemp("browse") / "pictures.mcap"
    with RecordingWriter(path, Provenance("test")) as sink:
        for k in range(5):
            rgb = np.full((48, 64, 3), 40 * k, np.uint8)
            image = message_class("CompressedImage")(data=encode_png(rgb), format="png")
            label = {"peer": "cf2", "u_px": 20, "v_px": 12, "depth_m": 1.0, "source": "truth"}
            sink.write(k * STEP_NS, topics.CAMERA_IMAGE("cf1"), image)
            peers = [label] if k < 4 else []
            sink.write(k * STEP_NS, topics.LABELS("cf1"), message_class("PeerLabels")(peers=peers))
    return path


@pytest.fixture(scope="module")
def folder(pictures: Path) -> Path:
    """Return the five images as a dataset."""
    out = pictures.with_name("set")
    dataset_stage.run([pictures], out, dataset_stage.Settings(split="none"))
    return out


@pytest.fixture(scope="module")
def detected_recording(pictures: Path) -> Path:
    """Return detections in the five images with the errors of `OFF_PX`."""
    path = pictures.with_name("found.mcap")
    with RecordingWriter(path, made_by("predict", Settings(), (pictures,))) as sink:
        for k, off_px in enumerate((*OFF_PX, 0.0)):
            seen = {"u_px": 20 + off_px, "v_px": 12, "depth_m": 1.5, "confidence": 0.9}
            cells = np.full((2, 6, 8), 0.1 * k, "<f4")
            grid = message_class("GridMap")(
                rows=6,
                cols=8,
                channels=["confidence", "depth_m"],
                data=cells.tobytes(),
                stride_px=8,
            )
            detections = message_class("Detections")(detections=[seen], threshold=0.5)
            sink.write(k * STEP_NS, topics.DETECTIONS("cf1"), detections)
            sink.write(k * STEP_NS, topics.GRID("cf1"), grid)
    return path


@pytest.fixture
def rrd(tmp_path: Path) -> Path:
    """Return the path of an .rrd file to be written."""
    return tmp_path / "rows.rrd"


def read_greys(path: Path) -> list[int]:
    """Return the grey level of each image, which identifies it, in the order of display."""
    return [bytes(pixels)[0] for (pixels,) in read_column(path, "/row/image", "Image:buffer")]


@pytest.mark.heavy
def test_the_worst_row_comes_first_and_those_without_a_peer_last(
    folder: Path, detected_recording: Path, rrd: Path
) -> None:
    assert save([folder, detected_recording], rrd, Settings()) == 5
    assert read_greys(rrd) == [40, 120, 0, 80, 160]
    errors_px = read_column(rrd, "/row/error_px", "Scalars:scalars")
    assert errors_px == [[30.0], [10.0], [3.0], [1.0]]
    facts = [words for (words,) in read_column(rrd, "/row/facts", "TextDocument:text")]
    assert "**30.0 px** pixel error" in facts[0]
    assert "**0.50 m** depth error" in facts[0]
    assert "recording pictures.mcap" in facts[0]
    assert "No peer in view" in facts[4]
    assert read_column(rrd, "/row/detections", "Points2D:positions")[0] == [[50.0, 12.0]]
    maps = read_column(rrd, "/row/grid/confidence", "DepthImage:buffer")
    assert np.frombuffer(bytes(maps[0][0]), "<f4")[0] == np.float32(0.1)


@pytest.mark.heavy
def test_a_dataset_alone_is_shown_in_its_order_with_its_own_maps(folder: Path, rrd: Path) -> None:
    assert save([folder], rrd, Settings()) == 5
    assert read_greys(rrd) == [0, 40, 80, 120, 160]
    assert "error by rank, px" not in read_panel_names(rrd)
    truth = open_dataset(folder).split("train").confidence
    maps = read_column(rrd, "/row/grid/confidence", "DepthImage:buffer")
    assert bytes(maps[0][0]) == truth[0].astype("<f4").tobytes()
    assert count_rows(rrd)["/row/labels/truth/points", "Points2D"] == 5


@pytest.mark.heavy
def test_rows_are_filtered_by_error_and_number(
    folder: Path, detected_recording: Path, rrd: Path
) -> None:
    between = Settings(error_from_px=2.0, error_to_px=20.0)
    assert save([folder, detected_recording], rrd, between) == 2
    assert read_greys(rrd) == [120, 0]
    rrd.unlink()
    assert save([folder, detected_recording], rrd, Settings(most=1)) == 1
    assert read_greys(rrd) == [40]


def test_filter_without_matches_reports_the_error_range(
    folder: Path, detected_recording: Path, rrd: Path
) -> None:
    with pytest.raises(
        SettingError, match=r"errors are 1\.00 to 30\.00 px. Change --error-from-px"
    ):
        save([folder, detected_recording], rrd, Settings(error_from_px=100.0))
    with pytest.raises(SettingError, match=r"name its recording as well"):
        save([folder], rrd, Settings(error_from_px=1.0))
    assert list(rrd.parent.glob("*.rrd*")) == []


def test_a_recording_of_other_images_is_refused(
    folder: Path, make_recording: Make, rrd: Path
) -> None:
    with pytest.raises(RecordingError, match=r"was not made from .*other\.mcap"):
        save([folder, make_recording("other.mcap")], rrd, Settings())
    with pytest.raises(RecordingError, match=r"has no detections. Try: dmrl predict"):
        save([folder, make_recording("blind.mcap", without=("detections",))], rrd, Settings())


def test_invalid_dataset_or_layout_is_reported(tmp_path: Path, folder: Path, rrd: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match=r"empty is not a dataset.*dmrl convert"):
        save([tmp_path / "empty"], rrd, Settings())
    (tmp_path / "empty/flight.mcap").touch()
    with pytest.raises(DatasetError, match=r"is not a dataset\. Name one in it: .*flight\.mcap$"):
        save([tmp_path / "empty"], rrd, Settings())
    with pytest.raises(SettingError, match=r"leave --layout flight out"):
        save([folder], rrd, Settings(layout="flight"))
    with pytest.raises(SettingError, match=r"layout dataset is for datasets"):
        save([folder.with_name("pictures.mcap")], rrd, Settings(layout="dataset"))
