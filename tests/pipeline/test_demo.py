"""The demo: its shipped flight, and the accuracy of dmrl-nano on it."""

import hashlib
import json
import tomllib
from pathlib import Path

import pytest
from mcap.reader import make_reader

from dmrl import recipe
from dmrl.pipeline import recipe_run
from dmrl.pipeline.plan import locate_input
from dmrl.stages.demo import suggest_commands

FLIGHT = Path(__file__).parents[2] / "recipes/demo_flight.mcap"
SHA256 = "ccd119a831c802188a0c78f2ad84d02a0363806670633ffa6a8a68fa8eaf1b74"
"""SHA-256 of the output of ``dmrl fly demo_flight recipes/demo_flight.mcap``."""


def test_shipped_flight_is_small_and_has_the_known_hash() -> None:
    content = FLIGHT.read_bytes()
    assert len(content) <= 3_000_000
    assert hashlib.sha256(content).hexdigest() == SHA256


def test_shipped_flight_has_the_settings_of_its_recipe() -> None:
    with FLIGHT.open("rb") as stream:
        held = {one.name: one.data for one in make_reader(stream).iter_attachments()}
    made_with = tomllib.loads(held["recipe.toml"].decode())
    wanted = recipe.read("demo_flight")
    assert {key: made_with[key] for key in wanted} == wanted


def test_step_finds_the_shipped_flight_by_name(tmp_path: Path) -> None:
    assert locate_input("demo_flight.mcap", set(), tmp_path, None).samefile(FLIGHT)
    assert locate_input("demo_flight.mcap", {"demo_flight.mcap"}, tmp_path, None).parent == tmp_path
    assert recipe.locate_recording("../demo_flight.mcap") is None
    assert recipe.locate_recording("demo.toml") is None


def test_suggested_commands_activate_the_environment_if_needed(tmp_path: Path) -> None:
    (tmp_path / "activate").touch()
    assert suggest_commands(Path("demo"), f"{tmp_path}/dmrl").startswith(f"  source {tmp_path}/act")
    assert suggest_commands(Path("demo"), "dmrl").startswith("  dmrl view demo/")
    assert suggest_commands(Path("demo"), "/usr/bin/dmrl").startswith("  dmrl view demo/")


@pytest.mark.heavy
def test_the_demo_finds_and_tracks_the_drone_of_the_flight(tmp_path: Path) -> None:
    flight, *_ = recipe.read_text("demo").split("[[step]]   # needs a Vulkan driver")
    (tmp_path / "flight.toml").write_text(flight, encoding="utf-8")
    recipe_run.run(tmp_path / "flight.toml", tmp_path / "out", workers=1)
    found = json.loads((tmp_path / "out/flight_detections/evaluation.json").read_text())
    assert found["overall"]["median_px"]["value"] < 1.0
    assert found["overall"]["f1"]["value"] > 0.9
    tracked = json.loads((tmp_path / "out/flight_errors/tracks.json").read_text())
    observer = next(one for one in tracked["robots"] if one["robot"] == "cf1")
    assert observer["rmse_m"] < 0.12 < observer["single_rmse_m"]


@pytest.mark.heavy
def test_the_demo_follows_the_other_drone_to_the_end(tmp_path: Path) -> None:
    *_, flight = recipe.read_text("demo").partition("[[step]]   # one drone follows")
    (tmp_path / "follow.toml").write_text(f'kind = "pipeline"\n[[step]]#{flight}', "utf-8")
    recipe_run.run(tmp_path / "follow.toml", tmp_path / "out", workers=1)
    (flown,) = json.loads((tmp_path / "out/follow_figures/flight.json").read_text())["flights"]
    assert flown["held_to_end"]
    assert flown["recall"] > 0.5
