"""``dmrl doctor`` lists installed and missing parts."""

import importlib.metadata
import json
import re
import shutil
from pathlib import Path

import pytest

from dmrl import boundary, installation
from dmrl.cli import app

ROOT = Path(__file__).parents[2]


def run_doctor_json(capsys: pytest.CaptureFixture[str]) -> dict[str, dict[str, object]]:
    """Run ``dmrl doctor --json``; return its parts by name."""
    app(["doctor", "--json"], result_action="return_value")
    return {part["name"]: part for part in json.loads(capsys.readouterr().out)}


@pytest.mark.heavy
def test_doctor_finds_the_base_installation(capsys: pytest.CaptureFixture[str]) -> None:
    output = run_doctor_json(capsys)
    assert output["base packages"]["there"] and output["Python"]["there"]
    assert "pyarrow" in str(output["base packages"]["found"])
    assert all(part["there"] or not part["needed"] for part in output.values())
    app(["doctor"], result_action="return_value")
    assert "The base works." in capsys.readouterr().out


def test_every_extra_is_listed_with_its_purpose() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text.partition("[project.optional-dependencies]")[2].partition("\n\n")[0]
    said = dict(re.findall(r"^(\w+) = \[.*?#\s*(.+)$", section, re.MULTILINE))
    assert said == installation.EXTRAS


@pytest.mark.heavy
def test_doctor_reports_missing_packages_with_install_commands(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    known = {"filterpy": "", "rosbags": "0.1"}
    real = importlib.metadata.version
    monkeypatch.setattr(
        installation, "_find_installed_version", lambda name: known.get(name, real(name))
    )
    monkeypatch.setattr(shutil, "which", lambda _: None)
    output = run_doctor_json(capsys)
    assert output["dmrl[label]"]["found"] == "no filterpy"
    assert output["dmrl[label]"]["remedy"] == "pip install 'dmrl[label]'"
    assert str(output["dmrl[ros]"]["found"]).startswith("rosbags 0.1, not ")
    assert output["C compiler"]["remedy"] == "apt-get install gcc"
    assert not output["NVIDIA GPU"]["there"]


@pytest.mark.heavy
def test_a_base_that_does_not_work_is_an_error(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.metadata.version
    monkeypatch.setattr(
        installation, "_find_installed_version", lambda name: "" if name == "mcap" else real(name)
    )
    assert boundary.run_to_status(lambda: app(["doctor"], result_action="return_value")) == 1
    assert capsys.readouterr().err == "dmrl: base packages: no mcap. Try: pip install dmrl\n"


def test_doctor_reports_missing_vulkan_driver(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(installation, "DRIVERS", (str(tmp_path),))
    monkeypatch.setattr("platform.system", lambda: "Linux")
    monkeypatch.delenv("VK_ICD_FILENAMES", raising=False)
    monkeypatch.delenv("VK_DRIVER_FILES", raising=False)
    assert not installation._find_vulkan().there
    assert installation._find_vulkan().remedy == "apt-get install mesa-vulkan-drivers"
