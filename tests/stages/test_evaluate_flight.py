"""`dmrl evaluate` for flights of a pilot."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dmrl import recipe as recipes
from dmrl import topics
from dmrl.errors import RecordingError
from dmrl.recording import read_summary, trim
from dmrl.stages import evaluate, fly
from dmrl.stages.fly import Flags, Settings


@pytest.fixture(scope="module")
def piloted_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a flight behind a leader that is missed in a third of the images, 10 s."""
    out = tmp_path_factory.mktemp("flight") / "flight.mcap"
    flags = Flags(duration_s=10.0, eye="ideal", camera=False, seed=2)
    settings = recipes.load("fly_follow", "fly", Settings, flags)
    fly.run(out, replace(settings, vision=replace(settings.vision, miss_share=1 / 3)))
    return out


def evaluate_flight(path: Path, what: Any = "auto") -> dict[str, Any]:
    """Return the document of an evaluation."""
    made = evaluate.run([path], None, evaluate.Settings(what=what))
    assert isinstance(made, dict)
    return made


@pytest.mark.heavy
def test_a_piloted_flight_is_evaluated_over_time(piloted_flight: Path) -> None:
    (one,) = evaluate_flight(piloted_flight)["flights"]
    assert (one["robot"], one["peer"]) == ("cf1", "cf2")
    assert one["held_s"] == pytest.approx(10.0, abs=0.1)
    assert one["contacts"] == 0
    assert one["recall"] == pytest.approx(2 / 3, abs=0.15)
    assert one["false_per_image"] == 0.0
    assert one["silences"] > 5
    assert 0.1 <= one["silence_s"] < 0.4
    assert sum(b["in_view"] for b in one["bands"] if b["by"] == "distance_m") == one["in_view"]


@pytest.mark.heavy
def test_tracks_of_such_a_flight_are_evaluated_on_request(piloted_flight: Path) -> None:
    assert evaluate_flight(piloted_flight, "tracks")["robots"][0]["robot"] == "cf1"


def test_flight_without_truth_is_refused(piloted_flight: Path, tmp_path: Path) -> None:
    short = tmp_path / "short.mcap"
    kept = [
        t for t in read_summary(piloted_flight).topics if not topics.parse_topic(topics.TRUTH, t)
    ]
    trim(piloted_flight, short, topics=[t for t in kept if t != "/tf"])
    with pytest.raises(RecordingError, match="no true position"):
        evaluate_flight(short, "flight")
