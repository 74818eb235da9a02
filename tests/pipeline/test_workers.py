"""Every command with --workers gives the same output with any number of workers."""

import inspect
import os
import shutil
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest

from dmrl.cli import COMMANDS, app
from dmrl.evaluation import detection_report
from dmrl.stages import fly, predict

FLIGHT = fly.Settings(2, 24.0, camera=True, cameras_max=1, camera_rate_hz=1.0)
CALLS: Mapping[str, tuple[str, ...]] = {
    "align": ("flights", "out"),
    "check": ("flights",),
    "convert": ("flights", "out", "--to", "csv"),
    "dataset": ("flights/a.mcap", "flights/b.mcap", "out"),
    "evaluate": ("found/a.mcap", "--plots", "out"),
    "index": ("flights",),
    "label": ("flights", "out", "--method", "ekf"),
    "predict": ("dmrl-nano", "flights", "out"),
    "recover": ("flights", "out"),
    "sketch": ("out", "--images", "250", "--seed", "4"),  # three parts of at most 100 images
    "track": ("found", "out"),
    "trim": ("flights", "out", "--from", "2"),
}
ELSEWHERE = {
    "run": "tests/pipeline/test_pipeline.py",
    "render": "tests/stages/test_render.py",
    "calibrate": "tests/stages/test_calibrate_sensors.py",
}
"""Commands that need other inputs, and the file that tests them with several workers."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two flights, and the detections of a network in them."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "flights").mkdir()
    (folder / "found").mkdir()
    for seed, name in enumerate(("a.mcap", "b.mcap")):
        flown = folder / "flights" / name
        fly.run(flown, replace(FLIGHT, seed=seed))
        predict.run(Path("dmrl-nano"), flown, folder / "found" / name, predict.Settings())
    return folder


@pytest.mark.heavy
def test_every_command_with_workers_is_tried() -> None:
    modules = {name: import_module(f"dmrl.stages.{name.replace('-', '_')}") for name in COMMANDS}
    asking = {
        name
        for name, module in modules.items()
        if "workers" in inspect.getfullargspec(module.command)[4]
        or hasattr(getattr(module, "NO_FLAGS", None), "workers")
    }
    assert asking == set(CALLS) | set(ELSEWHERE)


@pytest.mark.heavy
@pytest.mark.parametrize("command", CALLS)
def test_any_number_of_workers_writes_the_same_bytes(
    command: str,
    inputs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(detection_report, "MIN_PARALLEL_DRAWS", 0)  # parallel for few images too
    found = []
    numbers = ("1", "2")
    # All links are made before the first run, since `index` lists when a file changed.
    for workers in numbers:
        shutil.copytree(inputs, tmp_path / workers, copy_function=os.link)
    for workers in numbers:
        folder = tmp_path / workers
        monkeypatch.chdir(folder)
        words = [command, *CALLS[command], "--workers", workers]
        app(words, exit_on_error=False, result_action="return_value")
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        made = {str(path.relative_to(folder)): path.read_bytes() for path in files}
        found.append((made, capfd.readouterr().out))
    assert len(found[0][0]) > 4 or command == "check"
    assert found[0] == found[1]
