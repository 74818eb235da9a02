"""Flights of pilots with simulated vision: recorded topics, and reproducibility."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dmrl import recipe as recipes
from dmrl import topics
from dmrl.errors import ModelError, SettingError
from dmrl.flight.pilot import Command, Observation, Pilot
from dmrl.flight.pilots import PILOTS
from dmrl.images.codec import decode
from dmrl.recording import check, read, read_raw, read_summary, read_table, recover
from dmrl.simulation.settings import Vision
from dmrl.stages import convert, dataset, fly, predict, quantize, sketch, track
from dmrl.stages.fly import Flags, Settings

pytestmark = pytest.mark.heavy

SHORT = recipes.load(
    "fly_follow", "fly", Settings, Flags(duration_s=4.0, eye="ideal", camera=False, seed=2)
)
DRAWN = replace(SHORT, camera=True, camera_renderer="sketch", duration_s=3.0)


@pytest.fixture(scope="module")
def ideal_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight of 4 s with an ideal detector, without images."""
    out = tmp_path_factory.mktemp("ideal") / "flight.mcap"
    fly.run(out, SHORT)
    return out


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight of 3 s with the shipped network on sketched images."""
    out = tmp_path_factory.mktemp("seen") / "flight.mcap"
    fly.run(out, replace(DRAWN, eye=Path("dmrl-nano")))
    return out


def read_commands(path: Path, robot: str = "cf1") -> np.ndarray:
    """Return the (N, 4) commands of a robot: velocity, m/s, and yaw rate, rad/s."""
    table = read_table(path, topics.COMMAND(robot))
    names = ("vx_mps", "vy_mps", "vz_mps", "yaw_rate_radps")
    return np.column_stack([table[name].to_numpy() for name in names])


def test_specified_topics_have_their_rates(ideal_flight: Path) -> None:
    counts = {topic: info.count for topic, info in read_summary(ideal_flight).topics.items()}
    assert counts["/cf1/attitude"] == counts["/cf2/velocity"] == counts["/cf1/height"] == 401
    assert counts["/cf1/command"] == counts["/cf1/peer/cf2/truth"] == counts["/tf"] == 81
    assert counts["/cf1/detections"] == counts["/cf1/labels"] == 40
    assert counts["/cf1/tracks"] == 39  # the last image arrives after the end
    assert counts["/cf1/range/cf2"] > 100
    assert not [f for f in check(ideal_flight) if f.level == "error"]
    frames = {t.frame_id for t in (s.message for s in read(ideal_flight, "/cf1/tracks"))}
    assert frames == {"cf1/horizontal"}


def test_detections_of_an_ideal_eye_are_the_labels_with_its_errors(ideal_flight: Path) -> None:
    pixels, depths = [], []
    for label, found in zip(
        read(ideal_flight, "/cf1/labels"), read(ideal_flight, "/cf1/detections"), strict=True
    ):
        assert label.time_ns == found.time_ns
        (peer,), (one,) = label.message.peers, found.message.detections
        pixels += [one.u_px - peer.u_px, one.v_px - peer.v_px]
        depths.append(np.log(one.depth_m / peer.depth_m))
        assert one.confidence >= found.message.threshold > 0
    assert np.std(pixels) == pytest.approx(1.0, abs=0.3)
    assert np.std(depths) == pytest.approx(0.1, abs=0.04)


def test_follower_keeps_its_distance_by_detections_only(tmp_path: Path) -> None:
    out = tmp_path / "flight.mcap"
    fly.run(out, replace(SHORT, duration_s=12.0, distance_m=1.0))
    table = read_table(out, "/cf1/peer/cf2/truth")
    x, y = table["x"].to_numpy(), table["y"].to_numpy()
    late = table["log_time"].to_numpy() > 5e9
    assert np.hypot(x, y)[late].mean() == pytest.approx(1.0, abs=0.25)
    assert np.abs(np.arctan2(y, x))[late].max() < 0.72


def test_follower_without_detections_loses_the_leader(tmp_path: Path) -> None:
    out = tmp_path / "flight.mcap"
    fly.run(out, replace(SHORT, duration_s=12.0, vision=Vision(lost_share=1.0)))
    table = read_table(out, "/cf1/peer/cf2/truth")
    assert np.hypot(table["x"].to_numpy(), table["y"].to_numpy()).max() > 1.5
    assert read_summary(out).topics["/cf1/command"].count == 241


def test_flight_bytes_depend_only_on_the_seed(ideal_flight: Path, tmp_path: Path) -> None:
    for seed in (2, 3):
        fly.run(tmp_path / f"{seed}.mcap", replace(SHORT, seed=seed))
    assert (tmp_path / "2.mcap").read_bytes() == ideal_flight.read_bytes()
    assert not np.allclose(read_commands(tmp_path / "3.mcap"), read_commands(ideal_flight))


def test_flight_is_reproduced_from_its_recorded_recipe(seen: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "again.toml"
    made = read_summary(seen).provenance
    assert made.inputs[0].name == "dmrl-nano" and made.settings["backend"] in ("onnx", "torch")
    settings = {k: v for k, v in made.settings.items() if k != "model_threshold"}
    recipe.write_text(replace(made, settings=settings).to_recipe())
    fly.run(tmp_path / "again.mcap", recipes.load(recipe, "fly", Settings))
    np.testing.assert_array_equal(read_commands(tmp_path / "again.mcap"), read_commands(seen))


def test_predict_and_track_reproduce_onboard_results(seen: Path, tmp_path: Path) -> None:
    backend = read_summary(seen).provenance.settings["backend"]
    settings = predict.Settings(backend=backend, magnify=True)
    predict.run(Path("dmrl-nano"), seen, tmp_path / "found.mcap", settings)
    track.run(seen, tmp_path / "tracks.mcap", track.Settings())
    flown, again = (
        [
            (d.u_px, d.v_px, d.depth_m, d.confidence)
            for s in read(path, "/cf1/detections")
            for d in s.message.detections
        ]
        for path in (seen, tmp_path / "found.mcap")
    )
    # A flight rounds the detections that it writes.
    assert np.array(flown) == pytest.approx(np.array(again), abs=1e-7)
    flown, again = (
        [[(t.id, t.x, t.y, t.z) for t in s.message.tracks] for s in read(path, "/cf1/tracks")]
        for path in (seen, tmp_path / "tracks.mcap")
    )
    assert len(flown) == 29 and len(again) == 30
    for one, other in zip(flown, again, strict=False):
        # In flight the height is averaged over the past; dmrl track also uses the future.
        assert np.array(one) == pytest.approx(np.array(other), abs=0.02)


def test_tracks_are_published_one_image_late(ideal_flight: Path) -> None:
    for stamped in read_raw(ideal_flight, "/cf1/tracks"):
        assert stamped.publish_ns - stamped.time_ns == 100_000_000


class Witness(Pilot):
    """A pilot that records its observations and flies a constant command."""

    told: list[Observation] = []  # noqa: RUF012 - the test reads it

    def command(self, seen: Observation) -> Command:
        self.told.append(seen)
        return Command(0.3, 0.0, 0.0, 0.2)


@pytest.mark.parametrize("lost", range(8))
def test_image_age_is_exact_when_images_are_lost(
    lost: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One image is lost, so that its detections do not reach the pilot."""
    monkeypatch.setitem(PILOTS, "witness", Witness)
    Witness.told.clear()
    out = tmp_path / "flight.mcap"
    vision = Vision(lost_images=(lost,))
    fly.run(out, replace(SHORT, duration_s=1.5, pilot="witness", vision=vision))
    assert len(list(read(out, "/cf1/detections"))) == 14
    for seen in Witness.told:
        # Images are taken at 0.05, 0.15, ... s and arrive 0.1 s later.
        arrived = [k for k in range(15) if k != lost and 0.15 + 0.1 * k <= seen.time_s + 1e-9]
        if not arrived:
            assert seen.image_age_s == np.inf and not seen.tracks
        else:
            newest_s = 0.05 + 0.1 * arrived[-1]
            assert seen.image_age_s == pytest.approx(seen.time_s - newest_s)
            assert all(one.age_s >= seen.image_age_s - 1e-9 for one in seen.tracks)


@pytest.mark.parametrize("lost", [10, 17, 30])
def test_a_follower_never_acts_on_the_image_that_is_lost(lost: int, tmp_path: Path) -> None:
    """Commands differ from those of an undisturbed flight once the image would have arrived."""
    disturbed, whole = tmp_path / "disturbed.mcap", tmp_path / "whole.mcap"
    fly.run(disturbed, replace(SHORT, vision=Vision(lost_images=(lost,))))
    fly.run(whole, SHORT)
    got, wanted = read_commands(disturbed), read_commands(whole)
    arrives = 2 * lost + 3  # number of the first command after that
    np.testing.assert_array_equal(got[:arrives], wanted[:arrives])
    assert not np.array_equal(got[arrives], wanted[arrives])


def test_pilot_that_uses_the_truth_needs_no_camera(tmp_path: Path) -> None:
    out = tmp_path / "flight.mcap"
    fly.run(out, replace(SHORT, eye="truth", duration_s=2.0))
    held = read_summary(out).topics
    assert "/cf1/camera/image" not in held and "/cf1/detections" not in held
    assert held["/cf1/command"].count == 41


@pytest.mark.parametrize("pilot", ["follow", "keep_apart", "formation"])
def test_every_shipped_pilot_flies_any_recipe(pilot: str, tmp_path: Path) -> None:
    flags = Flags(duration_s=1.0, pilot=pilot, eye="ideal", camera=False)
    for name in ("fly_swarm", "fly_formation"):
        settings = recipes.load(name, "fly", Settings, flags)
        counts = fly.run(tmp_path / f"{name}.mcap", settings)
        assert counts["/{robot}/command"] == 21 * settings.flown


def test_robots_of_a_formation_keep_their_distance(tmp_path: Path) -> None:
    out = tmp_path / "flight.mcap"
    flags = Flags(duration_s=15.0, eye="truth", seed=1)
    fly.run(out, recipes.load("fly_formation", "fly", Settings, flags))
    for robot, peer in (("cf1", "cf2"), ("cf1", "cf3"), ("cf2", "cf3")):
        table = read_table(out, topics.TRUTH(robot, peer))
        away = np.linalg.norm([table[axis].to_numpy() for axis in "xyz"], axis=0)
        assert away.min() > 0.5
        if peer == "cf3":
            level = np.hypot(table["x"].to_numpy(), table["y"].to_numpy())[100:]
            assert level.mean() == pytest.approx(1.0, abs=0.1)


def test_a_killed_flight_is_recovered_up_to_its_last_second(tmp_path: Path) -> None:
    out, back = tmp_path / "flight.mcap", tmp_path / "back.mcap"
    words = ["fly", "fly_follow", str(out), "--eye", "ideal", "--no-camera", "--duration-s", "600"]
    flying = subprocess.Popen([sys.executable, "-m", "dmrl.cli", *words], stderr=subprocess.PIPE)
    partial = tmp_path / "flight.mcap.partial"
    for _ in range(600):
        if partial.exists() and partial.stat().st_size > 400_000:
            break
        time.sleep(0.1)
    flying.send_signal(signal.SIGKILL)
    flying.communicate()
    recover(partial, back)
    moments = read_table(back, "/cf1/command")["log_time"].to_numpy()
    assert len(moments) > 60
    assert np.diff(moments).max() == 50_000_000  # no gap
    assert not out.exists()


def test_errors_are_one_line_and_leave_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "flight.mcap"

    class Broken(Pilot):
        def command(self, seen: Observation) -> Command:
            return Command(float("nan"))

    monkeypatch.setitem(PILOTS, "broken", Broken)
    for wrong, error, text in (
        ({"pilot": "nobody"}, SettingError, "no pilot nobody"),
        ({"pilot": "broken"}, SettingError, "the command of cf1 is"),
        ({"eye": Path("nothing")}, SettingError, "needs images"),
        ({"eye": Path("nothing"), "camera": True}, ModelError, "no model nothing"),
        ({"flown": 5}, SettingError, "flown = 5"),
        ({"robots": 1}, SettingError, "1 robots"),
    ):
        with pytest.raises(error, match=text):
            fly.run(out, replace(SHORT, **wrong))
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_takes_pilot_eye_and_distance(tmp_path: Path) -> None:
    out = tmp_path / "flight.mcap"
    words = ["fly", "fly_in_view", str(out), "--pilot", "keep_apart", "--eye", "ideal"]
    words += ["--no-camera", "--distance-m", "0.9", "--duration-s", "1", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "dmrl.cli", *words], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout)["messages"]["/{robot}/command"] == 21
    settings = read_summary(out).provenance.settings
    assert (settings["pilot"], settings["eye"], settings["distance_m"]) == (
        "keep_apart",
        "ideal",
        0.9,
    )


@pytest.fixture(scope="module")
def int8_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the shipped network, quantised on sketched images."""
    folder = tmp_path_factory.mktemp("int8")
    sketch.run(folder / "pictures", sketch.Settings(images=24))
    convert.run(folder / "pictures", folder / "pictures.mcap", convert.Settings())
    dataset.run([folder / "pictures.mcap"], folder / "drawn", dataset.Settings())
    quantize.run(Path("dmrl-nano"), folder / "drawn", folder / "int8", quantize.Settings())
    return folder / "int8"


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", range(16))
def test_integer_and_c_backends_give_equal_commands(
    seed: int, int8_model: Path, tmp_path: Path
) -> None:
    flown = []
    for backend in ("integer", "c"):
        out = tmp_path / f"{backend}.mcap"
        settings = replace(DRAWN, eye=int8_model, backend=backend, duration_s=30.0, seed=seed)
        fly.run(out, settings)
        flown.append(read_commands(out))
    assert len(flown[0]) == 601 and np.abs(flown[0]).max() > 0.1
    np.testing.assert_array_equal(flown[0], flown[1])


def test_flights_with_the_same_place_share_only_the_room(tmp_path: Path) -> None:
    first = []
    for name, seed, place in (("a", 1, None), ("b", 2, 1), ("c", 2, None)):
        out = tmp_path / f"{name}.mcap"
        fly.run(out, replace(DRAWN, seed=seed, place=place, duration_s=1.0))
        rgb = decode(next(iter(read(out, "/cf1/camera/image"))).message.data).astype(float)
        first.append((rgb.mean(axis=(0, 1)), read_commands(out)))
    assert not np.allclose(first[0][1], first[1][1])
    np.testing.assert_array_equal(first[1][1], first[2][1])  # the ideal detector sees no room
    assert np.abs(first[1][0] - first[2][0]).max() > 2.0
