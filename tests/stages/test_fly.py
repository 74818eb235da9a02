"""`dmrl fly`: topics, frames, recipes and errors."""

import csv
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl import recipe as recipes
from dmrl.errors import OutputError, RecipeError, SettingError
from dmrl.flight import NOISE, Fault, Scenario, simulate
from dmrl.geometry.frames import AIDECK_PINHOLE
from dmrl.images.codec import decode
from dmrl.recording import check, read, read_summary, read_table
from dmrl.samples.flight import LOG_COLUMNS
from dmrl.simulation.settings import Vision
from dmrl.stages import convert, fly
from dmrl.stages.fly import Flags, Settings

SHORT = Settings(duration_s=4.0, seed=3)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight of three robots over 4 s; the first two carry a camera."""
    out = tmp_path_factory.mktemp("fly") / "seen.mcap"
    fly.run(out, Settings(3, 4.0, noise="harsh", seed=3, camera=True, cameras_max=2))
    return out


@pytest.mark.heavy
def test_every_topic_has_its_rate(recording: Path) -> None:
    counts = {topic: info.count for topic, info in read_summary(recording).topics.items()}
    assert counts["/cf3/attitude"] == counts["/cf3/velocity"] == counts["/cf3/height"] == 401
    assert counts["/cf2/peer/cf3/truth"] == counts["/tf"] == 80
    assert counts["/cf1/camera/image"] == counts["/cf1/labels"] == 20
    assert counts["/cf2/camera/calibration"] == 1
    assert 120 < counts["/cf3/range/cf1"] < 200
    assert "/cf3/camera/image" not in counts
    assert not [f for f in check(recording) if f.level == "error"]


@pytest.mark.heavy
def test_measurements_use_the_clock_of_the_robot(recording: Path) -> None:
    flight = simulate(Scenario(3, 4.0), NOISE["harsh"], 3)
    table = read_table(recording, "/cf2/velocity")
    assert np.allclose(table.column("vx_mps").to_numpy(), flight.robots["cf2"].vx_mps)
    times = table.column("log_time").to_numpy().astype(float) * 1e-9
    assert np.allclose(times, 1.0 + flight.robots["cf2"].time_s, atol=1e-8)
    assert abs(times[0] - 1.0) > 1e-3  # the clocks of harsh noise have offsets


def test_truth_labels_are_projections_of_the_true_positions(recording: Path) -> None:
    flight = simulate(Scenario(3, 4.0), NOISE["harsh"], 3)
    camera = AIDECK_PINHOLE
    for k, stamped in enumerate(read(recording, "/cf1/labels")):
        time_s = np.array([0.1 + 0.2 * k])
        assert stamped.time_ns == 1_000_000_000 + round(time_s[0] * 1e9)
        for label in stamped.message.peers:
            x, y, z = flight.peer_in_horizontal("cf1", label.peer, time_s)[0]
            truth = flight.truth["cf1"]
            roll = np.interp(time_s, truth.time_s, truth.roll)[0]
            pitch = np.interp(time_s, truth.time_s, truth.pitch)[0]
            # Computed by hand: pitch about y first, then roll about x.
            x, z = x * np.cos(pitch) - z * np.sin(pitch), x * np.sin(pitch) + z * np.cos(pitch)
            y, z = y * np.cos(roll) + z * np.sin(roll), -y * np.sin(roll) + z * np.cos(roll)
            assert label.depth_m == pytest.approx(x)
            assert label.u_px == pytest.approx(camera.cx_px - camera.fx_px * y / x)
            assert label.v_px == pytest.approx(camera.cy_px - camera.fy_px * z / x)
            assert (label.source, label.status) == ("truth", 0)


def test_truth_is_exact_and_in_the_frame_of_the_observer(recording: Path) -> None:
    stamped = next(read(recording, "/cf2/peer/cf3/truth"))
    flight = simulate(Scenario(3, 4.0), NOISE["harsh"], 3)
    xyz = flight.peer_in_horizontal("cf2", "cf3", np.zeros(1))[0]
    assert (stamped.message.x, stamped.message.y, stamped.message.z) == pytest.approx(tuple(xyz))
    assert list(stamped.message.covariance) == [0.0] * 9
    assert stamped.message.frame_id == "cf2/horizontal"


def test_transforms_lead_from_the_world_to_the_lens(recording: Path) -> None:
    transforms = next(read(recording, "/tf")).message.transforms
    names = [(t.parent_frame_id, t.child_frame_id) for t in transforms][:3]
    assert names == [
        ("world", "cf1/horizontal"),
        ("cf1/horizontal", "cf1/camera"),
        ("cf1/camera", "cf1/optical"),
    ]
    for transform in transforms:
        q = transform.rotation
        assert q.x**2 + q.y**2 + q.z**2 + q.w**2 == pytest.approx(1.0)


@pytest.mark.heavy
def test_the_same_settings_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        fly.run(tmp_path / name, SHORT)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


@pytest.mark.heavy
def test_a_flight_survives_the_way_through_csv(tmp_path: Path) -> None:
    flight = simulate(Scenario(duration_s=4.0), NOISE["calibrated"], 3)
    folder = tmp_path / "csv"
    folder.mkdir()
    for robot, log in flight.robots.items():
        ((_, peer),) = [pair for pair in flight.ranges if pair[0] == robot]
        ranges = dict(_assign_ranges(flight.ranges[robot, peer].time_s, log.time_s))
        with (folder / f"{robot}.csv").open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["time_s", *LOG_COLUMNS, f"range_{peer}_m"])
            for k in range(len(log.time_s)):
                at = ranges.get(k)
                value = "" if at is None else flight.ranges[robot, peer].range_m[at]
                columns = [getattr(log, name)[k] for name in LOG_COLUMNS]
                writer.writerow([1.0 + log.time_s[k], *columns, value])
    fly.run(tmp_path / "flown.mcap", Settings(duration_s=4.0, noise="calibrated", seed=3))
    convert.run(folder, tmp_path / "converted.mcap", convert.Settings())
    for topic in ("/cf1/attitude", "/cf2/velocity", "/cf1/height"):
        flown, converted = (
            read_table(tmp_path / f"{name}.mcap", topic) for name in ("flown", "converted")
        )
        assert flown.equals(converted)
    flown, converted = (
        read_table(tmp_path / f"{name}.mcap", "/cf1/range/cf2") for name in ("flown", "converted")
    )
    assert flown.column("range_m").equals(converted.column("range_m"))


def _assign_ranges(ranged_s: np.ndarray, logged_s: np.ndarray) -> list[tuple[int, int]]:
    """Return row of the log and number of each range, which belongs to the next row."""
    rows = np.searchsorted(logged_s, ranged_s)
    assert all(one < other for one, other in pairwise(rows))
    return [(int(row), k) for k, row in enumerate(rows)]


@pytest.mark.parametrize("name", ["fly_in_view", "fly_swarm"])
def test_shipped_recipes_can_be_flown(name: str, tmp_path: Path) -> None:
    settings = recipes.load(name, "fly", Settings, Flags(duration_s=1.0))
    assert fly.run(tmp_path / "out.mcap", settings)["/tf"] == 20


def test_every_wrong_key_of_a_recipe_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text('kind = "fly"\nrobots = "two"\ntrajectory = "loop"\nwind = 3\n')
    with pytest.raises(RecipeError) as caught:
        recipes.load(path, "fly", Settings)
    assert all(key in str(caught.value) for key in ("robots", "trajectory", "wind"))


@pytest.mark.heavy
def test_faults_of_a_recipe_are_simulated_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "faulty.toml", tmp_path / "out.mcap"
    path.write_text(
        'kind = "fly"\nduration_s = 6.0\nseed = 3\n'
        '[[faults]]\nkind = "height_gap"\nrobot = "cf2"\nstart_s = 2\nduration_s = 1\n'
        '[[faults]]\nkind = "range_gap"\nrobot = "cf1"\npeer = "cf2"\nstart_s = 1\n'
        '[[faults]]\nkind = "attitude_gap"\nrobot = "cf1"\nstart_s = 4\nduration_s = 1\n'
    )
    fly.run(out, recipes.load(path, "fly", Settings))
    told = capsys.readouterr().err.splitlines()
    assert told[:2] == ["height_gap of cf2: 2.0-3.0 s", "range_gap of cf1-cf2: 1.0-6.0 s"]
    counts = {topic: info.count for topic, info in read_summary(out).topics.items()}
    assert (counts["/cf2/height"], counts["/cf1/height"]) == (501, 601)
    assert counts["/cf1/attitude"] == 501
    assert counts["/cf1/range/cf2"] < 60
    yaw = read_table(out, "/cf1/attitude", fields=("yaw_rad",))["yaw_rad"].to_numpy()
    assert np.isfinite(yaw).all()
    assert [f for f in check(out) if f.level == "error"] == []
    again = tmp_path / "again.toml"
    again.write_text(read_summary(out).provenance.to_recipe())
    fly.run(tmp_path / "again.mcap", recipes.load(again, "fly", Settings))
    assert (tmp_path / "again.mcap").read_bytes() == out.read_bytes()


def test_wrong_faults_are_named_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(
        'kind = "fly"\n[[faults]]\nkind = "gremlins"\nrobot = "cf1"\n'
        '[[faults]]\nkind = "nlos"\nrobot = "cf1"\nduration_s = -2.0\n'
        '[[faults]]\nkind = "nlos"\nrobot = "cf1"\nwhen = 3\n'
    )
    with pytest.raises(RecipeError) as caught:
        recipes.load(path, "fly", Settings)
    said = str(caught.value)
    assert "\n" not in said
    assert "faults.0.kind" in said and "faults.1: nlos of cf1 must last over 0 s" in said
    assert "faults.2.when" in said


def test_bad_settings_leave_no_file(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    for bad in (
        Settings(robots=1),
        Settings(duration_s=0.1),
        Settings(seed=-1),
        Settings(camera_rate_hz=0.0),
        Settings(cameras_max=0),
        Settings(faults=(Fault("nlos", "cf3"),)),
    ):
        with pytest.raises(SettingError):
            fly.run(out, bad)
    out.write_text("mine")
    with pytest.raises(OutputError, match="never overwritten"):
        fly.run(out, SHORT)
    assert out.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"backend": "c", "pilot": ""}, "backend has no effect without a pilot"),
        ({"backend": "c", "eye": "truth"}, "backend has no effect with --eye truth"),
        ({"cameras_max": 1}, "cameras_max has no effect with a pilot"),
        ({"yaw_spread_rad": 1.0}, "yaw_spread_rad has no effect with a pilot"),
        ({"vision": Vision(miss_share=0.1), "eye": Path("m")}, "vision.miss_share has no effect"),
        ({"vision": Vision(magnify=False), "eye": "ideal"}, "vision.magnify has no effect"),
        ({"vision": Vision(delay_images=2), "eye": "truth"}, "vision.delay_images has no effect"),
        ({"flown": 2}, "--pilot follow flies all robots and has no leader"),
    ],
)
def test_a_setting_without_effect_is_refused(
    given: dict[str, Any], named: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match=named):
        fly.run(tmp_path / "out.mcap", replace(Settings(pilot="follow"), **given))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ("delay_images = -1", "vision.delay_images: must be >= 0"),
        ("delay_images = 11", "vision.delay_images: must be <= 10"),
        ("miss_share = 1.0", "vision.miss_share: must be < 1"),
        ("lost_images = [0, -1]", "vision.lost_images: must be >= 0"),
        ("depth_std_ratio = 1000.0", "vision.depth_std_ratio: must be <= 1"),
    ],
)
def test_limits_of_keys_in_a_table_hold(given: str, fault: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(f'kind = "fly"\npilot = "follow"\n[vision]\n{given}\n')
    with pytest.raises(RecipeError, match=fault):
        recipes.load(path, "fly", Settings)


@pytest.mark.slow
def test_blender_images_of_a_flight_match_their_labels_and_share_a_background(
    blender: Path, tmp_path: Path
) -> None:
    drawn = Settings(2, 3.0, seed=0, camera=True, camera_rate_hz=1.0)
    rendered = replace(drawn, camera_renderer="blender", cameras_max=1)
    paths = [tmp_path / f"{name}.mcap" for name in ("drawn", "rendered", "again")]
    for path, settings in zip(paths, (drawn, rendered, rendered), strict=True):
        fly.run(path, settings)
    assert paths[1].read_bytes() == paths[2].read_bytes()
    expected, found = (
        [stamped.message.peers for stamped in read(path, "/cf1/labels")] for path in paths[:2]
    )
    assert len(found) == 3
    for one, other in zip(found, expected, strict=True):
        (label,), (sketched,) = one, other
        assert (label.u_px, label.v_px) == pytest.approx((sketched.u_px, sketched.v_px), abs=1e-3)
        assert label.depth_m == pytest.approx(sketched.depth_m)
        if len(label.box_px):
            left, top, right, bottom = label.box_px
            assert left < label.u_px < right and top < label.v_px < bottom
    assert sum(len(peers[0].box_px) > 0 for peers in found) >= 2
    images = [decode(s.message.data).astype(float) for s in read(paths[1], "/cf1/camera/image")]
    # Consecutive images correlate, because the background stays the same during a flight.
    assert np.corrcoef(images[0].ravel(), images[1].ravel())[0, 1] > 0.7
