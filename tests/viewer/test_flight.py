"""Logged data of the layout ``flight``, read back from the .rrd files."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import recipe as recipes
from dmrl import topics
from dmrl.colours import RGB, STATUS_RGB
from dmrl.errors import SettingError
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter, sample_topics
from dmrl.recording.mcap import batch_reader
from dmrl.recording.mcap.chunks import chunk_builder, chunk_reader
from dmrl.stages import fly as fly_stage
from dmrl.viewer import Settings, save, scene
from dmrl.viewer.session import prepare_show

from .rrd import count_rows, read_column, read_columns, read_panel_names

pytestmark = pytest.mark.heavy

Make = Callable[..., Path]
POSITION, TRUTH = "/cf1/peer/cf2/position", "/cf1/peer/cf2/truth"
STILL = ("/tf/cf1/horizontal", "Transform3D")
"""A transform that never changes has one row."""


@pytest.fixture
def rrd(tmp_path: Path) -> Path:
    """Return the path of an .rrd file to be written."""
    return tmp_path / "flight.rrd"


def count_timed_rows(path: Path) -> dict[tuple[str, str], int]:
    """Return the number of rows with a time, without those of labels and detections."""
    return {
        key: n
        for key, n in count_rows(path).items()
        if not key[1].startswith("static") and not key[0].startswith(("/cf1/lab", "/cf1/det"))
    }


def test_every_message_of_a_flight_becomes_its_archetypes(make_flight: Make, rrd: Path) -> None:
    assert save([make_flight()], rrd, Settings()) == 20
    plots = ["distance", "error/x", "error/y", "bound/x", "bound/y", "nees", "nees/limit"]
    assert count_timed_rows(rrd) == {
        STILL: 1,
        ("/tf/cf2/horizontal", "Transform3D"): 20,
        ("/tf/cf1/camera", "Transform3D"): 20,
        ("/tf/cf2/camera", "Transform3D"): 20,
        ("/cf1/camera/image", "EncodedImage"): 20,
        (TRUTH, "Points3D"): 20,
        (f"{TRUTH}/trail", "LineStrips3D"): 20,
        (f"{TRUTH}/distance", "Scalars"): 20,
        (POSITION, "Points3D"): 20,
        (f"{POSITION}/covariance", "Ellipsoids3D"): 20,
        (f"{POSITION}/trail", "LineStrips3D"): 20,
        (f"{POSITION}/status", "StateChange"): 20,
        **{(f"{POSITION}/{name}", "Scalars"): 20 for name in plots},
        ("/cf1/range/cf2", "Scalars"): 20,
        ("/cf1/range/cf2/line", "LineStrips3D"): 20,
        ("/cf2/range/cf1", "Scalars"): 20,
        ("/cf2/range/cf1/sphere", "Ellipsoids3D"): 20,
        ("/cf1/tracks", "Points3D"): 20,
        ("/cf1/tracks/velocity", "Arrows3D"): 20,
        ("/cf1/tracks/covariance", "Ellipsoids3D"): 20,
        **{(f"/cf{k}/height", "Scalars"): 20 for k in (1, 2)},
        **{
            (f"/cf{k}/attitude/{n}", "Scalars"): 20
            for k in (1, 2)
            for n in ("roll", "pitch", "yaw")
        },
    }
    still = {key for key in count_rows(rrd) if key[1].startswith("static")}
    assert {
        ("/tf/cf1/optical", "static Transform3D"),
        ("/cf1/camera/calibration", "static Pinhole"),
        ("/cf1/body", "static Mesh3D"),
        ("/cf2/body", "static TransformAxes3D"),
    } <= still


def test_the_panels_have_units(make_flight: Make, rrd: Path) -> None:
    save([make_flight()], rrd, Settings())
    assert read_panel_names(rrd) == {
        "space, world, grid 1 m",
        "cf1 image",
        "distance of cf2, m",
        "distance of cf1, m",
        "error along x, m",
        "error along y, m",
        "NEES of x and y, 2 dof",
        "status of positions",
        "height, m",
        "attitude of cf1, degrees",
        "attitude of cf2, degrees",
        "yaw, degrees",
    }


def test_errors_bounds_and_nees_are_right(make_flight: Make, rrd: Path) -> None:
    save([make_flight()], rrd, Settings())
    values = {
        name: np.array(read_column(rrd, f"{POSITION}/{name}", "Scalars:scalars"))
        for name in ("error/x", "bound/x", "bound/y", "nees", "distance")
    }
    assert values["error/x"] == pytest.approx(0.1)
    assert values["bound/x"] == pytest.approx(np.tile([0.3, -0.3], (20, 1)))
    assert values["bound/y"] == pytest.approx(np.tile([0.6, -0.6], (20, 1)))
    assert values["nees"] == pytest.approx(1.0)
    assert values["distance"] == pytest.approx(1.1)


def test_an_ellipsoid_has_two_sigmas_along_the_axes_of_the_covariance(
    make_flight: Make, rrd: Path
) -> None:
    save([make_flight()], rrd, Settings())
    (half,) = read_column(rrd, f"{POSITION}/covariance", "Ellipsoids3D:half_sizes")[0]
    assert sorted(half) == pytest.approx([0.1, 0.2, 0.4])
    (xyzw,) = read_column(rrd, f"{POSITION}/covariance", "Ellipsoids3D:quaternions")[0]
    x, y, z, w = xyzw
    # The axis with the largest half size points along y.
    axes = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    spread = axes @ np.diag(np.array(half) ** 2) @ axes.T
    assert spread == pytest.approx(4 * np.diag([0.01, 0.04, 0.0025]), abs=1e-6)


def test_trails_are_in_the_world_and_positions_in_the_robots_frame(
    make_flight: Make, rrd: Path
) -> None:
    save([make_flight()], rrd, Settings())
    strips = read_column(rrd, f"{TRUTH}/trail", "LineStrips3D:strips")
    # cf1 is at (1, 2, 0.5) and faces along y, so that 1 m ahead is (1, 3, 0.5).
    assert strips[5][0][1] == pytest.approx([1.0, 3.0, 0.5], abs=1e-6)
    assert read_column(rrd, f"{TRUTH}/trail", "CoordinateFrame:frame") == [["world"]]
    assert read_column(rrd, TRUTH, "CoordinateFrame:frame") == [["cf1/horizontal"]]
    assert read_column(rrd, "/cf1/camera/image", "CoordinateFrame:frame") == [["cf1/image"]]


def test_without_tf_everything_is_around_the_robot(make_flight: Make, rrd: Path) -> None:
    save([make_flight(without=("/tf",))], rrd, Settings(robot="cf1"))
    assert "space, cf1/horizontal, grid 1 m" in read_panel_names(rrd)
    strips = read_column(rrd, f"{TRUTH}/trail", "LineStrips3D:strips")
    assert strips[5][0][1] == pytest.approx([1.0, 0.0, 0.0])
    assert read_column(rrd, f"{TRUTH}/trail", "CoordinateFrame:frame") == [["cf1/horizontal"]]


def test_frames_have_a_place_at_the_time_that_a_viewer_opens_at(
    make_flight: Make, rrd: Path
) -> None:
    save([make_flight(moving=True)], rrd, Settings())
    found = read_columns(rrd)
    opens_ns, _ = found["/cf1/camera/image", "EncodedImage:blob"][0]
    first_ns, pose = found["/tf/cf1/horizontal", "Transform3D:translation"][0]
    assert first_ns == opens_ns
    assert pose is not None


def test_a_range_points_to_where_the_peer_is_thought_to_be(make_flight: Make, rrd: Path) -> None:
    save([make_flight()], rrd, Settings())
    ((start, end),) = read_column(rrd, "/cf1/range/cf2/line", "LineStrips3D:strips")[0]
    assert (start, end) == ([0, 0, 0], pytest.approx([1.05, 0, 0]))
    assert read_column(rrd, "/cf2/range/cf1/sphere", "Ellipsoids3D:half_sizes")[0] == [[1, 1, 1]]


def test_an_estimate_that_is_not_ok_has_the_colour_of_its_status(
    make_flight: Make, rrd: Path
) -> None:
    save([make_flight()], rrd, Settings())
    colours = [rgba >> 8 for (rgba,) in read_column(rrd, POSITION, "Points3D:colors")]
    doubted = int.from_bytes(bytes(STATUS_RGB["UNCONVERGED"]))
    assert colours == [doubted] * 5 + [int.from_bytes(bytes(RGB["estimate"]))] * 15
    states = read_column(rrd, f"{POSITION}/status", "StateChange:state")
    assert states == [["UNCONVERGED"]] * 5 + [["OK"]] * 15


def test_a_track_disappears_when_it_ends(make_flight: Make, rrd: Path) -> None:
    save([make_flight()], rrd, Settings())
    assert read_column(rrd, "/cf1/tracks", "Points3D:labels") == [["cf2 3"]] * 15 + [[]] * 5
    assert read_column(rrd, "/cf1/tracks/covariance", "Ellipsoids3D:half_sizes")[19] == []


def test_yaw_is_unwrapped(make_flight: Make, rrd: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The yaw starts at 3.1 rad, grows by 0.01 rad a message, and is read in many batches.
    monkeypatch.setattr(scene, "MIN_BATCH_ROWS", 1)
    save([make_flight()], rrd, Settings())
    yaw = np.array(read_column(rrd, "/cf1/attitude/yaw", "Scalars:scalars"))[:, 0]
    assert yaw == pytest.approx(np.degrees(3.1 + 0.01 * np.arange(20)))
    roll = read_column(rrd, "/cf1/attitude/roll", "Scalars:scalars")
    assert roll[0][0] == pytest.approx(np.degrees(0.1))


def test_flight_without_images_is_shown(make_flight: Make, rrd: Path) -> None:
    assert save([make_flight(without=("camera", "labels", "detections"))], rrd, Settings()) == 0
    assert "cf1 image" not in read_panel_names(rrd)
    assert count_timed_rows(rrd)[POSITION, "Points3D"] == 20


def test_from_and_to_hold_for_plots_too(make_flight: Make, rrd: Path) -> None:
    assert save([make_flight()], rrd, Settings(from_s=0.5, to_s=1.0)) == 5
    assert count_timed_rows(rrd)[STILL] == 1
    assert {n for key, n in count_timed_rows(rrd).items() if key != STILL} == {5}


def test_every_thins_images_and_leaves_plots_whole(make_flight: Make, rrd: Path) -> None:
    assert save([make_flight()], rrd, Settings(every=4)) == 5
    assert count_timed_rows(rrd)["/cf1/camera/image", "EncodedImage"] == 5
    assert count_timed_rows(rrd)[f"{POSITION}/nees", "Scalars"] == 20


def test_empty_time_span_is_refused(make_flight: Make, rrd: Path) -> None:
    recording = make_flight(without=("camera", "labels", "detections"))
    with pytest.raises(SettingError, match=r"lasts from 0 to 1.900 s. Change --from-s or --to-s"):
        save([recording], rrd, Settings(from_s=1.0, to_s=1.0))


def test_unknown_robot_error_lists_known_ones(make_flight: Make, rrd: Path) -> None:
    with pytest.raises(SettingError, match=r"no robot cf9 in .*It has: cf1, cf2"):
        save([make_flight()], rrd, Settings(robot="cf9"))


def test_images_come_first_and_wait_for_no_more_of_the_flight(
    make_flight: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunk_builder, "CHUNK_BYTES", 1)
    monkeypatch.setattr(batch_reader, "JOINED_BYTES", 1)
    monkeypatch.setattr(sys.modules[sample_topics.__module__], "CHUNKS_PER_CHANNEL_MAX", 2)
    opened: list[int] = []
    unpacked = chunk_reader.decompress
    monkeypatch.setattr(
        chunk_reader,
        "decompress",
        lambda chunk, at: opened.append(at) or unpacked(chunk, at),
    )
    show = prepare_show([make_flight()], Settings())
    paths, before = [], None
    for times, entity in show.logged():
        if times is not None:
            paths.append(entity.path)
            before = before or len(set(opened))
    assert paths[0] == "/cf1/camera/image"
    assert before is not None
    assert before < len(set(opened)) / 2


def test_trails_errors_and_ranges_are_independent_of_batch_boundaries(
    make_flight: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def save_and_read(name: str) -> dict[tuple[str, str], list[Any]]:
        path = tmp_path / f"{name}.rrd"
        save([make_flight(f"{name}.mcap", moving=True)], path, Settings())
        return {
            key: values
            for key, values in read_columns(path).items()
            if "/peer/" in key[0] or "/range/" in key[0]
        }

    whole = save_and_read("whole")
    monkeypatch.setattr(chunk_builder, "CHUNK_BYTES", 1)
    monkeypatch.setattr(batch_reader, "JOINED_BYTES", 1)
    monkeypatch.setattr(scene, "MIN_BATCH_ROWS", 1)
    pieces = save_and_read("pieces")
    assert len(whole[f"{TRUTH}/trail", "LineStrips3D:strips"]) == 20
    assert whole.keys() == pieces.keys()
    assert [key for key, values in whole.items() if values != pieces[key]] == []


def test_piloted_flight_shows_commands_maps_and_detection_gaps(tmp_path: Path, rrd: Path) -> None:
    flags = fly_stage.Flags(eye=Path("dmrl-nano"), camera_renderer="sketch", duration_s=1.0)
    settings = recipes.load("fly_follow", "fly", fly_stage.Settings, flags)
    fly_stage.run(tmp_path / "flight.mcap", settings)
    save([tmp_path / "flight.mcap"], rrd, Settings())
    rows = count_rows(rrd)
    for field in ("vx_mps", "vy_mps", "vz_mps"):
        assert rows[f"/cf1/command/{field}", "Scalars"] >= 20
    assert rows["/cf1/detections/sight", "StateChange"] == 10
    assert rows["/cf1/peer/cf2/truth/trail", "LineStrips3D"] >= 20
    assert rows["/cf2/peer/cf1/truth/trail", "LineStrips3D"] >= 19
    shown = read_panel_names(rrd)
    assert {"commands, m/s", "detections, per image", "cf1 confidence", "cf1 depth, m"} <= shown
    states = read_column(rrd, "/cf1/detections/sight", "StateChange:state")
    assert {state for (state,) in states} <= {"detected", "not detected"}


def test_innovations_and_causes_of_a_pair_are_plots(
    make_flight: Make, rrd: Path, tmp_path: Path
) -> None:
    cause = {"name": "flow does not fit", "probability": 0.9, "from_s": 0.5, "to_s": 1.0}
    innovation = {"signal": "range", "at_s": [0.25, 1.5], "size": [0.5, 4.0]}
    made = message_class("PeerCauses")(causes=[{**cause, "robot": "cf2"}], innovations=[innovation])
    with RecordingWriter(tmp_path / "causes.mcap", Provenance("test")) as sink:
        sink.write(0, topics.CAUSES("cf1", "cf2"), made)
    save([make_flight(), tmp_path / "causes.mcap"], rrd, Settings())
    path = topics.CAUSES("cf1", "cf2")
    assert read_column(rrd, f"{path}/innovation/range", "Scalars:scalars") == [[0.5], [4.0]]
    drawn = read_column(rrd, f"{path}/cause/cf2_flow_does_not_fit", "Scalars:scalars")
    assert [value for (value,) in drawn] == pytest.approx([0, 0, 0.9, 0.9, 0, 0])
    assert {"innovations, sigmas", "causes, probability"} <= set(read_panel_names(rrd))
