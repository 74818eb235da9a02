"""Focal lengths in the manifest of a dataset: written, read back, missing, or damaged."""

import json
from pathlib import Path

import pytest

from dmrl.datasets.layout import MANIFEST_FILE
from dmrl.datasets.manifest import Manifest, Shard, load_manifest
from dmrl.errors import DatasetError

SHARDS = {"train": [Shard("data-00000-of-00001.arrow", 3, 99)]}


def test_similar_focal_lengths_are_listed_once(tmp_path: Path) -> None:
    one = Manifest().with_part(SHARDS, [184.0, 190.0, 120.0])
    two = one.with_part({"test": SHARDS["train"]}, [123.0, 400.0])
    two.write(tmp_path)
    assert two.focal_px == [184.0, 120.0, 400.0]
    assert load_manifest(tmp_path) == two


def test_an_older_manifest_has_no_focal_lengths(tmp_path: Path) -> None:
    Manifest().with_part(SHARDS).write(tmp_path)
    path = tmp_path / MANIFEST_FILE
    said = json.loads(path.read_text())
    del said["focal_px"]
    path.write_text(json.dumps(said))
    assert (known := load_manifest(tmp_path)) and known.focal_px == []


@pytest.mark.parametrize("value", [184, ["x"], [0.0], [True], [float("nan")], None])
def test_damaged_focal_lengths_give_one_line_error(tmp_path: Path, value: object) -> None:
    Manifest().with_part(SHARDS).write(tmp_path)
    path = tmp_path / MANIFEST_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), "focal_px": value}))
    with pytest.raises(DatasetError, match="is damaged"):
        load_manifest(tmp_path)
