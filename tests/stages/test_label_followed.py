"""Labels of a flight in which the observer follows its peer, with an ideal camera."""

from pathlib import Path

import numpy as np
import pytest

import dmrl
from dmrl import recipe as recipes
from dmrl.stages import fly
from dmrl.stages.fly import Flags, Settings


@pytest.mark.heavy
@pytest.mark.parametrize("seed", [6, 7])
def test_a_followed_peer_is_not_moved_away(tmp_path: Path, seed: int) -> None:
    flight, out = tmp_path / "flight.mcap", tmp_path / "labelled.mcap"
    flags = Flags(eye="ideal", camera=False, seed=seed)
    fly.run(flight, recipes.load("fly_follow", "fly", Settings, flags))
    dmrl.label(flight, out, detections=True)
    labelled = dmrl.open(out)
    true, found = (labelled[f"/cf1/peer/cf2/{name}"].to_pandas() for name in ("truth", "position"))
    true_m = np.hypot(true["x"], true["y"])
    expected_m = np.interp(found.index, true.index, true_m)
    too_far_m = np.hypot(found["x"], found["y"]) - expected_m
    assert abs(too_far_m.mean()) < 0.045
