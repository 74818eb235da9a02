"""Reset, step and render of `dmrl.simulation`."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmrl.errors import SettingError
from dmrl.simulation import Command, Simulation


@pytest.mark.heavy
def test_the_same_seed_and_commands_give_the_same_numbers() -> None:
    def fly(seed: int) -> list[np.ndarray]:
        simulation = Simulation(robots=3, flown=2, duration_s=5.0)
        seen = simulation.reset(seed)
        for k in range(20):
            seen = simulation.step({"cf1": (0.3, 0.0, 0.0, 0.5), "cf2": Command(0.1 * k)})
        own = [(*one.velocity_mps, one.height_m, one.roll_rad) for one in seen.values()]
        return [np.array(own), simulation.render("cf1").rgb]

    first, again, other = fly(1), fly(1), fly(2)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert not np.array_equal(first[0], other[0])


def test_reset_starts_the_same_flight_again() -> None:
    simulation = Simulation(duration_s=1.0)
    start = simulation.reset(3)["cf1"]
    while not simulation.is_over:
        simulation.step({"cf1": (0.5, 0.0, 0.0, 0.0)})
    assert simulation.time_s == pytest.approx(1.0)
    # A step beyond the end has no effect.
    assert simulation.step({})["cf1"].time_s == pytest.approx(1.0)
    again = simulation.reset(3)["cf1"]
    assert again.time_s == 0.0 and again.height_m == start.height_m


@pytest.mark.heavy
def test_an_image_shows_the_peers_that_are_in_front() -> None:
    simulation = Simulation(robots=2, flown=1)
    simulation.reset(1)
    picture = simulation.render("cf1")
    x, *_ = simulation.peer_position("cf1", "cf2")
    assert picture.rgb.shape == (224, 320, 3)
    assert picture.depth_m[0] == pytest.approx(x, abs=0.05) == pytest.approx(0.8, abs=0.05)
    assert picture.visible_share[0] > 0.5
    # Turn until the peer is behind the robot.
    while abs(np.arctan2(*simulation.peer_position("cf1", "cf2")[1::-1])) < 2.5:
        simulation.step({"cf1": (0.0, 0.0, 0.0, 1.5)})
    assert len(simulation.render("cf1").depth_m) == 0


@pytest.mark.heavy
def test_ten_robots_fly_their_own_commands() -> None:
    simulation = Simulation(robots=10, trajectory="random", duration_s=3.0, noise="ideal")
    simulation.reset(0)
    for _ in range(40):
        seen = simulation.step({f"cf{k}": (0.05 * k, 0.0, 0.0, 0.0) for k in range(1, 11)})
    assert len(seen) == 10
    for k in range(1, 11):
        assert seen[f"cf{k}"].velocity_mps[0] == pytest.approx(0.05 * k, abs=0.01)
        assert len(seen[f"cf{k}"].range_m) == 9


def test_wrong_commands_are_named() -> None:
    simulation = Simulation(robots=2, flown=1)
    with pytest.raises(SettingError, match="reset"):
        simulation.step({})
    simulation.reset(0)
    for commands, text in (
        ({"cf2": (0, 0, 0, 0)}, "cf2 flies no commands"),
        ({"cf1": (0, 0, 0)}, "Give vx, vy, vz"),
        ({"cf1": (float("nan"), 0, 0, 0)}, "Give vx, vy, vz"),
    ):
        with pytest.raises(SettingError, match=text):
            simulation.step(commands)
    with pytest.raises(SettingError, match="robots cannot be flown"):
        Simulation(robots=30).reset(0)


def test_import_of_the_simulation_loads_neither_numpy_nor_torch() -> None:
    code = "import sys, dmrl.simulation; print(sorted({'numpy', 'torch'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.heavy
def test_example_environment_passes_the_gymnasium_check() -> None:
    pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env  # noqa: PLC0415 - optional

    path = Path(__file__).parents[1] / "examples" / "follow_env.py"
    assert len(path.read_text().splitlines()) < 80
    spec = importlib.util.spec_from_file_location("follow_env", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    env = module.FollowEnv(duration_s=1.0)
    check_env(env, skip_render_check=True)


@pytest.mark.parametrize("settings", [{"noise": "loud"}, {"camera_renderer": "oil"}])
def test_unknown_choices_are_reported(settings: dict[str, Any]) -> None:
    with pytest.raises(SettingError, match="Choose one of"):
        Simulation(**settings)


def test_unknown_robots_numbers_and_commands_are_reported() -> None:
    simulation = Simulation(duration_s=1.0)
    with pytest.raises(SettingError, match="Call reset"):
        simulation.observe("cf1")
    for wrong in (-1, 1.5, None):
        with pytest.raises(SettingError, match=r"seed = .*\. Give a whole number, 0 or more"):
            simulation.reset(wrong)  # type: ignore[arg-type]
    simulation.reset(1)
    for ask in (
        lambda: simulation.render("cf9"),
        lambda: simulation.observe("cf9"),
        lambda: simulation.peer_position("cf1", "cf9"),
    ):
        with pytest.raises(SettingError, match=r"'cf9': there is none\. Choose one of cf1"):
            ask()
    with pytest.raises(SettingError, match="the command of cf1 is None"):
        simulation.step({"cf1": None})  # type: ignore[dict-item]
