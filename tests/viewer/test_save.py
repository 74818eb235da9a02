"""Logged data of recordings of images, read back from the .rrd files."""

import errno
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from dmrl.colours import RGB, paint_viridis
from dmrl.errors import OutputError, RecordingError, SettingError, SourceError
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, read_table
from dmrl.stages import view
from dmrl.viewer import Settings, save
from dmrl.viewer.drawing.archetypes import NO_VALUE_COLOUR
from dmrl.viewer.session import prepare_show, write_rrd

from .rrd import count_rows, read_column, read_panel_names, read_queries

Make = Callable[..., Path]
IMAGES = "/cf1/camera/image"


@pytest.fixture
def rrd(tmp_path: Path) -> Path:
    """Return the path of an .rrd file to be written."""
    return tmp_path / "flight.rrd"


@pytest.mark.heavy
def test_every_topic_becomes_its_archetypes(make_recording: Make, rrd: Path) -> None:
    assert save([make_recording()], rrd, Settings()) == 10
    found = count_rows(rrd)
    assert {key: n for key, n in found.items() if not key[1].startswith("static")} == {
        ("/cf1/camera/image", "EncodedImage"): 10,
        ("/cf1/labels/truth/points", "Points2D"): 10,
        ("/cf1/labels/truth/boxes", "Boxes2D"): 10,
        ("/cf1/labels/truth/texts", "Points2D"): 10,
        ("/cf1/labels/published/points", "Points2D"): 10,
        ("/cf1/labels/published/boxes", "Boxes2D"): 10,
        ("/cf1/labels/published/texts", "Points2D"): 10,
        ("/cf1/detections", "Points2D"): 10,
        ("/cf1/detections/texts", "Points2D"): 10,
        ("/cf1/detections/weak", "Points2D"): 10,
        ("/cf1/detections/grid/confidence", "DepthImage"): 10,
        ("/cf1/detections/grid/depth_m", "Image"): 10,
        ("/cf1/detections/grid/best", "Boxes2D"): 10,
        ("/cf1/labels/truth/sigmas", "Ellipses2D"): 10,
        ("/cf1/labels/published/sigmas", "Ellipses2D"): 10,
    }
    assert {path for path, kind in found if kind == "static LineStrips2D"} == {
        "/cf1/legend/sources",
        "/cf1/legend/confidence/ticks",
        "/cf1/legend/depth_m/ticks",
    }
    assert list(rrd.parent.glob("*.partial")) == []


@pytest.mark.heavy
def test_images_are_logged_as_they_are(make_recording: Make, rrd: Path) -> None:
    recording = make_recording()
    save([recording], rrd, Settings())
    table = read_table(recording, IMAGES)
    blobs = [bytes(blob) for (blob,) in read_column(rrd, IMAGES, "EncodedImage:blob")]
    assert blobs == table["data"].to_pylist()
    kinds = [kind for (kind,) in read_column(rrd, IMAGES, "EncodedImage:media_type")]
    assert kinds == ["image/jpeg", "image/png"] * 5


@pytest.mark.heavy
def test_labels_show_peer_and_depth_while_the_peer_is_visible(
    make_recording: Make, rrd: Path
) -> None:
    save([make_recording()], rrd, Settings())
    texts = read_column(rrd, "/cf1/labels/truth/texts", "Points2D:labels")
    assert texts == [["cf2 1.25 m"]] * 9 + [[]]
    boxes = read_column(rrd, "/cf1/labels/truth/boxes", "Boxes2D:half_sizes")
    assert boxes == [[[6.0, 5.0]]] * 9 + [[]]
    assert read_column(rrd, "/cf1/labels/published/boxes", "Boxes2D:half_sizes") == [[]] * 10
    colours = {
        source: read_column(rrd, f"/cf1/labels/{source}/points", "Points2D:colors")[0][0] >> 8
        for source in ("truth", "published")
    }
    assert colours == {
        source: int.from_bytes(bytes(RGB[source])) for source in ("truth", "published")
    }


@pytest.mark.heavy
def test_a_detection_below_the_threshold_is_in_no_view_and_has_no_text(
    make_recording: Make, rrd: Path
) -> None:
    save([make_recording()], rrd, Settings())
    texts = "/cf1/detections/texts"
    assert read_column(rrd, texts, "Points2D:labels") == [["conf 0.90, 1.20 m"]] * 10
    ((_, point_v),), ((_, text_v),) = (
        read_column(rrd, path, "Points2D:positions")[0] for path in ("/cf1/detections", texts)
    )
    assert 0 < text_v - point_v < 2  # the text is half a robot below: image of 64 px, 1.2 m away
    assert read_column(rrd, "/cf1/detections", "Points2D:radii") == [[-4.0]]
    weak = read_column(rrd, "/cf1/detections/weak", "Points2D:positions")
    assert [len(points) for points in weak] == [1] * 10
    assert read_column(rrd, "/cf1/detections/weak", "Points2D:radii") == [[-1.5]]
    lines = {line for query in read_queries(rrd) for line in query}
    assert {"/cf1/detections", texts} <= lines
    assert not any("weak" in line or "detections/**" in line for line in lines)


@pytest.mark.heavy
def test_maps_have_fixed_ranges_and_cells_of_eight_pixels(make_recording: Make, rrd: Path) -> None:
    save([make_recording()], rrd, Settings(depth_max_m=2.5))
    grid = "/cf1/detections/grid"
    assert read_column(rrd, f"{grid}/confidence", "DepthImage:depth_range") == [[[0.0, 1.0]]]
    assert read_column(rrd, f"{grid}/depth_m", "Transform3D:scale") == [[[8.0, 8.0, 1.0]]]
    colours = np.frombuffer(
        bytes(read_column(rrd, f"{grid}/depth_m", "Image:buffer")[0][0]), np.uint8
    )
    colours = colours.reshape(6, 8, 3)
    assert (colours[[1, 4], [2, 4]] == paint_viridis(np.array([1.2, 1.8]) / 2.5)).all()
    # Cells of low confidence are grey, which is not the colour of 0 m.
    assert (colours[3, 4] == NO_VALUE_COLOUR).all()


@pytest.mark.heavy
def test_a_single_robot_gets_four_panels_and_two_get_three_each(
    make_recording: Make, tmp_path: Path
) -> None:
    save([make_recording()], tmp_path / "one.rrd", Settings())
    save([make_recording("two.mcap", ("cf1", "cf2"))], tmp_path / "two.rrd", Settings())
    maps = {"image", "confidence", "depth, m"}
    over = {"cf1 confidence over image"}
    assert read_panel_names(tmp_path / "one.rrd") == {f"cf1 {name}" for name in maps} | over
    assert read_panel_names(tmp_path / "two.rrd") == {
        f"cf{k} {name}" for k in (1, 2) for name in maps
    }


def test_a_recording_of_images_only_has_one_panel(make_recording: Make, rrd: Path) -> None:
    save([make_recording(without=("labels", "detections"))], rrd, Settings())
    assert read_panel_names(rrd) == {"cf1 image"}
    assert {path for path, kind in count_rows(rrd) if "static" not in kind} == {IMAGES}


@pytest.mark.heavy
def test_from_to_and_every_select_images_and_their_data(make_recording: Make, rrd: Path) -> None:
    assert save([make_recording()], rrd, Settings(from_s=0.2, to_s=0.8, every=2)) == 3
    moving = {n for (_, kind), n in count_rows(rrd).items() if "static" not in kind}
    assert moving == {3}
    times = {
        ns
        for chunk in RrdReader(rrd).stream()
        if not chunk.is_static
        for ns in chunk.to_record_batch()["log_time"].cast("int64").to_pylist()
    }
    assert times == {200_000_000, 400_000_000, 600_000_000}


@pytest.mark.parametrize(
    ("start_ns", "kind"), [(0, "duration[ns]"), (1_700_000_000 * 10**9, "timestamp[ns]")]
)
def test_log_time_counts_from_zero_unless_it_is_a_date(
    make_recording: Make, rrd: Path, start_ns: int, kind: str
) -> None:
    save([make_recording(start_ns=start_ns)], rrd, Settings())
    kinds = {
        str(chunk.to_record_batch()["log_time"].type)
        for chunk in RrdReader(rrd).stream()
        if not chunk.is_static
    }
    assert kinds == {kind}


@pytest.mark.heavy
def test_recordings_that_belong_together_are_shown_as_one(make_recording: Make, rrd: Path) -> None:
    pictures = make_recording("pictures.mcap", without=("labels", "detections"))
    found = make_recording("found.mcap", without=("camera",))
    assert save([found, pictures], rrd, Settings()) == 10
    assert count_rows(rrd)["/cf1/detections/grid/confidence", "DepthImage"] == 10


def test_a_robot_may_have_any_name(make_recording: Make, rrd: Path) -> None:
    save([make_recording(robots=("drone #1 (blue)",))], rrd, Settings())
    assert count_rows(rrd)[r"/drone\ \#1\ \(blue\)/camera/image", "EncodedImage"] == 10


def test_an_unknown_source_of_labels_is_shown_too(
    tmp_path: Path, make_recording: Make, rrd: Path
) -> None:
    with RecordingWriter(tmp_path / "odd.mcap", Provenance("test")) as sink:
        peers = message_class("PeerLabels")(
            peers=[{"peer": "cf9", "depth_m": 1, "source": "guess"}]
        )
        sink.write(0, "/cf1/labels", peers)
    pictures = make_recording(without=("labels", "detections"))
    save([pictures, tmp_path / "odd.mcap"], rrd, Settings())
    assert count_rows(rrd)["/cf1/labels/guess/points", "Points2D"] == 1
    assert read_column(rrd, "/cf1/legend/sources", "LineStrips2D:labels") == [["guess"]]


def test_without_images_the_missing_topic_is_named(make_recording: Make, rrd: Path) -> None:
    recording = make_recording(without=("camera",))
    with pytest.raises(RecordingError, match=r"no images \(/\*/camera/image\) in .*flight.mcap"):
        save([recording], rrd, Settings())
    assert list(rrd.parent.glob("*.rrd*")) == []


def test_labels_of_a_robot_without_images_are_reported(
    make_recording: Make, rrd: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures, others = (
        make_recording(),
        make_recording("others.mcap", ("cf7",), without=("camera",)),
    )
    save([pictures, others], rrd, Settings())
    assert "cf7 has labels or detections but no images" in capsys.readouterr().err


def test_a_time_without_images_is_refused(make_recording: Make, rrd: Path) -> None:
    with pytest.raises(SettingError, match=r"lasts from 0 to 0.900 s. Change --from-s or --to-s"):
        save([make_recording()], rrd, Settings(from_s=5.0))
    assert list(rrd.parent.glob("*.rrd*")) == []


@pytest.mark.parametrize("settings", [{"from_s": float("nan")}, {"to_s": float("inf")}])
def test_non_finite_time_is_refused(
    make_recording: Make, rrd: Path, settings: dict[str, float]
) -> None:
    with pytest.raises(SettingError, match=r"s is not a time\. Give seconds from the start"):
        save([make_recording()], rrd, Settings(**settings))


def test_an_output_is_never_overwritten(make_recording: Make, rrd: Path) -> None:
    rrd.write_bytes(b"mine")
    with pytest.raises(OutputError, match="never overwritten"):
        save([make_recording()], rrd, Settings())
    assert rrd.read_bytes() == b"mine"


@pytest.mark.heavy
def test_full_disk_raises_an_error_while_saving(make_recording: Make) -> None:
    """rerun itself reports no reason and sometimes waits forever, hence several attempts."""
    show = prepare_show([make_recording()], Settings())
    for _ in range(20):
        with (
            Path("/dev/full").open("wb", buffering=0) as disk,
            pytest.raises(OSError, match="/dev/full") as e,
        ):
            write_rrd(show, disk)
        assert e.value.errno == errno.ENOSPC


def test_a_recording_that_is_cut_short_leaves_no_file(make_recording: Make, rrd: Path) -> None:
    recording = make_recording()
    recording.write_bytes(recording.read_bytes()[:-100])
    with pytest.raises(RecordingError, match=r"flight\.mcap"):
        save([recording], rrd, Settings())
    assert list(rrd.parent.glob("*.rrd*")) == []


def test_undecodable_image_is_reported(tmp_path: Path, rrd: Path) -> None:
    with RecordingWriter(tmp_path / "bad.mcap", Provenance("test")) as sink:
        sink.write(0, IMAGES, message_class("CompressedImage")(data=b"no picture", format="png"))
    with pytest.raises(SourceError, match="no image of /cf1/camera/image can be decoded"):
        save([tmp_path / "bad.mcap"], rrd, Settings())


def test_output_suffix_must_match_its_flag(make_recording: Make, tmp_path: Path) -> None:
    recording = make_recording()
    for to, other in (("save_to", "found.png"), ("screenshot_to", "found.rrd")):
        with pytest.raises(SettingError, match=rf"{other}: --save writes \.rrd"):
            view.command([recording], **{to: tmp_path / other})
