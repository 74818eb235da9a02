"""Commands load no heavy package that they do not need."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = {
    *("torch", "onnx", "onnxruntime", "safetensors", "tensorboard", "sympy", "h5py", "jinja2"),
    *("filterpy", "scipy.stats", "scipy.optimize", "cv2", "matplotlib", "pandas", "duckdb"),
    *("rerun", "rosbags", "cflib", "ray", "fsspec", "bpy", "datasets"),
}
TABLE = {
    "info flight.mcap": set(),
    "check flight.mcap": set(),
    "trim flight.mcap trimmed.mcap --to-s 1": set(),
    "convert flight.mcap tables --to csv": {"pandas"},
    "label flight.mcap labelled.mcap --gate-m 9": {"scipy.optimize"},
    "predict dmrl-nano flight.mcap found.mcap --backend onnx": {"onnxruntime"},
    "predict dmrl-nano flight.mcap torch.mcap --backend torch": {
        "torch",
        "safetensors",
        "sympy",
        "h5py",
    },
}
"""Packages of `HEAVY` that each command may load."""
LISTED = f"print(*(m for m in {sorted(HEAVY)} if m in sys.modules), file=open('loaded', 'w'))"
CODE = f"import sys\nfrom dmrl.cli import main\ntry:\n    main()\nfinally:\n    {LISTED}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a simulated flight, and an ONNX model in its cache."""
    folder = tmp_path_factory.mktemp("start")
    run_dmrl(
        "fly fly_in_view flight.mcap --duration-s 12 --seed 5 --camera --camera-rate-hz 1", folder
    )
    run_dmrl("predict dmrl-nano flight.mcap first.mcap --backend onnx", folder)  # caches the model
    return folder


def run_dmrl(line: str, folder: Path) -> set[str]:
    """Run a command; return the heavy packages that it has loaded."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-P", "-c", CODE, *line.split()]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set((folder / "loaded").read_text().split())


@pytest.mark.heavy
@pytest.mark.parametrize("line", TABLE)
def test_a_command_loads_only_the_packages_of_its_row(line: str, folder: Path) -> None:
    assert run_dmrl(line, folder) <= TABLE[line]
