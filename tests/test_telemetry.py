"""No dependency sends usage data or stores an identifier of the user."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dmrl.guards.telemetry import OPT_OUT

CI = ("CI", "TF_BUILD", "GITHUB_ACTIONS", "JENKINS_URL", "BUILD_ID")
"""Variables by which onnxruntime recognises a build server, where it sends no usage data."""


def make_user_environment(home: Path) -> dict[str, str]:
    """Return the environment of a user who has not opted out of any usage data."""
    dropped = {*OPT_OUT, *CI}
    kept = {name: value for name, value in os.environ.items() if name not in dropped}
    places = ("HOME", "TMPDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")
    return kept | dict.fromkeys(places, str(home))


def test_import_switches_every_dependency_off() -> None:
    code = f"import os, dmrl; print({{k: os.environ[k] for k in {sorted(OPT_OUT)}}})"
    environment = {**os.environ, **dict.fromkeys(OPT_OUT, "")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(dict(sorted(OPT_OUT.items())))


@pytest.mark.heavy
def test_onnxruntime_leaves_no_identifier(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    home = tmp_path / "home"
    home.mkdir()
    code = (
        "import numpy as np\n"
        "import dmrl\n"
        "from dmrl.deploy.detector import open_detector\n"
        "from dmrl.learn.pretrained import resolve_model_path\n"
        "from pathlib import Path\n"
        "detector = open_detector(resolve_model_path(Path('dmrl-nano')), 'onnx')\n"
        "detector.grids([np.zeros((224, 320, 3), np.uint8)])\n"
    )
    subprocess.run([sys.executable, "-c", code], env=make_user_environment(home), check=True)
    kept = [p.relative_to(home).as_posix() for p in home.rglob("*") if p.is_file()]
    assert [name for name in kept if not name.startswith((".cache/dmrl/onnx/", "dmrl/onnx/"))] == []
