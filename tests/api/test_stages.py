"""Stages as functions write what their commands write."""

import gc
import subprocess
import sys
from pathlib import Path

import pytest

import dmrl
from dmrl.cli import app
from dmrl.errors import RecipeError


def test_the_bytes_are_those_of_the_command(flight: Path, tmp_path: Path) -> None:
    app(
        ["label", str(flight), str(tmp_path / "a.mcap"), "--gate-m", "0.4"],
        result_action="return_value",
    )
    dmrl.label(flight, tmp_path / "b.mcap", gate_m=0.4)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_a_recording_without_a_name_lives_as_long_as_its_object(flight: Path) -> None:
    made = dmrl.trim(dmrl.open(flight), from_s=1.0, to_s=2.0)
    path = made.path
    assert path.exists() and 90 <= len(made["/cf1/height"]) <= 110
    del made
    gc.collect()
    assert not path.exists()


def test_topics_and_images_keep_a_temporary_recording_there(flight: Path) -> None:
    topic = dmrl.trim(flight, from_s=1.0, to_s=2.0)["/cf1/height"]
    images = dmrl.trim(flight, from_s=1.0, to_s=2.0).images("cf1")[:1]
    gc.collect()
    assert len(topic.to_numpy()) == len(topic) and len(images[0]) == 224
    paths = [topic.path, images.path]
    del topic, images
    gc.collect()
    assert not any(path.exists() for path in paths)


def test_wrong_settings_are_said(flight: Path) -> None:
    with pytest.raises(RecipeError, match="gate: "):
        dmrl.label(flight, gate=0.4)


@pytest.mark.heavy
def test_nothing_heavy_is_loaded_before_it_is_used(flight: Path) -> None:
    code = (
        "import sys, dmrl; first = set(sys.modules)\n"
        f"dmrl.open({str(flight)!r})['/cf1/height'].to_numpy()\n"
        "heavy = {'torch', 'rerun', 'matplotlib', 'cv2', 'onnxruntime'}\n"
        "print(sorted(heavy & set(sys.modules)), 'numpy' in first)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split("\n")[0] == "[] False"


def test_public_names_are_those_that_type_checkers_see() -> None:
    stub = Path(dmrl.__file__).with_suffix(".pyi").read_text()
    told = {line.rpartition(" as ")[2] for line in stub.splitlines() if " as " in line}
    assert told == set(dmrl._PLACES)
    for name in told:
        assert getattr(dmrl, name).__module__ == f"dmrl.api.{dmrl._PLACES[name]}"
    with pytest.raises(AttributeError, match="dmrl has no shut"):
        getattr(dmrl, "shut")  # noqa: B009
