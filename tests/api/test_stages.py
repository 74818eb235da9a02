"""Stages as Python functions: the same outputs as their commands."""

import gc
import json
import subprocess
import sys
from pathlib import Path

import pytest

import dmrl
from dmrl.cli import app
from dmrl.errors import RecipeError, SettingError

pytestmark = pytest.mark.heavy


def test_python_stages_write_the_bytes_of_their_commands(flight: Path, tmp_path: Path) -> None:
    app(
        ["label", str(flight), str(tmp_path / "a.mcap"), "--gate-m", "0.4"],
        result_action="return_value",
    )
    dmrl.label(flight, tmp_path / "b.mcap", gate_m=0.4)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_temporary_recording_lives_as_long_as_its_object(flight: Path) -> None:
    made = dmrl.trim(dmrl.open(flight), from_s=1.0, to_s=2.0)
    path = made.path
    assert path.exists() and 90 <= len(made["/cf1/height"]) <= 110
    del made
    gc.collect()
    assert not path.exists()


def test_topics_and_images_keep_a_temporary_recording_alive(flight: Path) -> None:
    topic = dmrl.trim(flight, from_s=1.0, to_s=2.0)["/cf1/height"]
    images = dmrl.trim(flight, from_s=1.0, to_s=2.0).images("cf1")[:1]
    gc.collect()
    assert len(topic.to_numpy()) == len(topic) and len(images[0]) == 224
    paths = [topic.path, images.path]
    del topic, images
    gc.collect()
    assert not any(path.exists() for path in paths)


def test_wrong_settings_name_the_setting(flight: Path) -> None:
    with pytest.raises(RecipeError, match="gate: "):
        dmrl.label(flight, gate=0.4)


def test_empty_list_is_refused_and_one_recording_is_accepted(flight: Path, tmp_path: Path) -> None:
    for stage in (dmrl.evaluate, dmrl.merge):
        with pytest.raises(SettingError, match="empty list"):
            stage([])
    for made in (dmrl.calibrate, dmrl.make_dataset):
        with pytest.raises(SettingError, match="empty list"):
            made([], tmp_path / "out")
    with pytest.raises(SettingError, match="two recordings"):
        dmrl.merge([flight])
    assert list(tmp_path.iterdir()) == []
    assert len(dmrl.make_dataset(flight, tmp_path / "set")) > 0


def test_evaluate_returns_the_printed_figures(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = dmrl.predict("dmrl-nano", flight, tmp_path / "seen.mcap")
    labelled = dmrl.label(flight, tmp_path / "labelled.mcap")
    for path, word in ((seen.path, "median error, px"), (labelled.path, "cf2 sees cf1")):
        judged = dmrl.evaluate(path)
        app(["evaluate", str(path), "--json"], result_action="return_value")
        assert dict(judged) == json.loads(capsys.readouterr().out)
        assert word in judged._repr_html_() and word in repr(judged)


def test_evaluate_takes_a_piloted_flight(tmp_path: Path) -> None:
    flown = dmrl.fly(
        tmp_path / "flown.mcap",
        recipe="fly_follow",
        duration_s=2.0,
        eye="ideal",
        camera_renderer="sketch",
    )
    judged = dmrl.evaluate(flown)
    assert judged["flights"][0]["peer"] == "cf2" and "contacts" in repr(judged)


def test_numbers_out_of_range_and_folders_of_convert_are_reported(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="threshold: must be <= 1"):
        dmrl.evaluate("none.mcap", threshold=2.0)
    with pytest.raises(SettingError, match="makes recordings, not yolo"):
        dmrl.convert("set", tmp_path / "out", to="yolo")
    assert not list(tmp_path.iterdir())


def test_nothing_heavy_is_loaded_before_it_is_used(flight: Path) -> None:
    code = (
        "import sys, dmrl; first = set(sys.modules)\n"
        f"dmrl.open({str(flight)!r})['/cf1/height'].to_numpy()\n"
        "heavy = {'torch', 'rerun', 'matplotlib', 'cv2', 'onnxruntime'}\n"
        "print(sorted(heavy & set(sys.modules)), 'numpy' in first)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split("\n")[0] == "[] False"


def test_public_names_equal_the_type_stub() -> None:
    stub = Path(dmrl.__file__).with_suffix(".pyi").read_text()
    told = {line.rpartition(" as ")[2] for line in stub.splitlines() if " as " in line}
    assert told == set(dmrl._PLACES)
    for name in told:
        assert getattr(dmrl, name).__module__ == f"dmrl.api.{dmrl._PLACES[name]}"
    with pytest.raises(AttributeError, match="dmrl has no shut"):
        getattr(dmrl, "shut")  # noqa: B009
