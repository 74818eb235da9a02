"""The card of an extended dataset, its sample images, and comparison with another dataset."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dmrl import cli
from dmrl.card.changes import compare_datasets
from dmrl.stages.dataset import Settings, add, run

from .conftest import Record, build_peer

pytestmark = pytest.mark.heavy


def test_samples_are_twelve_images_at_most_with_a_mark_on_each_label(
    record: Record, tmp_path: Path
) -> None:
    run([record(peers=[[build_peer()]] * 20)], tmp_path / "many", Settings(split="none"))
    assert "![12 images with their labels" in (tmp_path / "many" / "README.md").read_text()
    with Image.open(tmp_path / "many" / "figures" / "samples.jpg") as image:
        tile_px = np.asarray(image.convert("L"), float)[:264, :320]
    # Samples are enlarged five times; a white circle of 10 px surrounds each label.
    v, u = np.mgrid[:264, :320]
    radius = np.hypot(u - 5 * 20.5, v - 5 * 12.5)
    assert tile_px[(radius > 8) & (radius < 9.5)].mean() > 200


def test_a_dataset_that_grew_names_every_recording_with_its_share(
    record: Record, tmp_path: Path
) -> None:
    run([record(peers=[[build_peer()]] * 9, seed=1)], tmp_path / "out", Settings(split="none"))
    old = shutil.copytree(tmp_path / "out", tmp_path / "old")
    add([record("second.mcap", peers=[[build_peer()]] * 3, seed=2)], tmp_path / "out", Settings())
    text = (tmp_path / "out" / "README.md").read_text()
    assert "| second.mcap | train | 3 | 25.0 % |" in text
    assert re.search(r"^\| 1 \| dmrl [\d.]+ \| `flight.mcap` \| 9 \| 75.0 % \|$", text, re.M)
    assert "Version 1.1.0" in text and "images: 2 recordings" in text
    changes = {one.what: one[1:] for one in compare_datasets(tmp_path / "out", old)}
    assert changes["images"] == (9, 12)
    assert changes["images of second.mcap in train"] == (None, 3)
    assert "names of peers" not in changes
    assert compare_datasets(old, old) == []


def test_the_command_lists_differences_and_writes_nothing(
    record: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, peers in (
        ("old", [[build_peer()]] * 4),
        ("new", [[build_peer()], [build_peer(peer="cf3")]]),
    ):
        run([record(f"{name}.mcap", peers=peers)], tmp_path / name, Settings(split="none"))
    before = (tmp_path / "new" / "README.md").stat().st_mtime_ns
    flags = ["card", str(tmp_path / "new"), "--since", str(tmp_path / "old")]
    cli.app(flags, result_action="return_value")
    assert re.search(r"names of peers +cf2 +cf2, cf3", capsys.readouterr().out)
    cli.app([*flags, "--json"], result_action="return_value")
    found = json.loads(capsys.readouterr().out)["changes"]
    assert {"what": "images", "before": 4, "now": 2} in found
    assert (tmp_path / "new" / "README.md").stat().st_mtime_ns == before
