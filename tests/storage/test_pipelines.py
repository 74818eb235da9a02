"""Pipelines whose folder is in a bucket."""

from pathlib import Path
from typing import Any

import pytest

from dmrl import recipe as recipes
from dmrl.pipeline import recipe_run as pipeline
from dmrl.storage import to_path

from ..pipeline.chain import CHAIN


@pytest.mark.heavy
def test_a_pipeline_keeps_its_folder_in_a_bucket(lab: Any, tmp_path: Path) -> None:
    recipe = tmp_path / "chain.toml"
    recipe.write_text(CHAIN)
    pipeline.run(recipe, tmp_path / "here", workers=1)
    made = pipeline.run(recipe, to_path("s3://lab/chain"), workers=1)
    assert not any(one.skipped for one in made)
    for name in ("pictures.mcap", "short.mcap"):
        assert lab.cat_file(f"lab/chain/{name}") == (tmp_path / "here" / name).read_bytes()
    assert all(one.skipped for one in pipeline.run(recipe, to_path("s3://lab/chain"), workers=1))
    assert not [name for name in lab.find("lab/chain") if "unfinished" in name]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_demo_pipeline_in_a_bucket_equals_the_local_one(lab: Any, tmp_path: Path) -> None:
    """The demo runs with fewer images and without the step that draws with rerun."""
    text = recipes.read_text("demo").replace("images = 600", "images = 20")
    text = text.replace("epochs = 12", "epochs = 1")
    recipe = tmp_path / "small.toml"
    steps = text.split("[[step]]")
    recipe.write_text("[[step]]".join(s for s in steps if "needs a Vulkan driver" not in s))
    there = to_path("s3://lab/demo")
    pipeline.run(recipe, tmp_path / "here", workers=1)
    made = pipeline.run(recipe, there, workers=1)
    assert [one.stage for one in made] == [
        *("predict", "evaluate", "track", "evaluate"),
        *("sketch", "convert", "dataset", "train", "predict", "evaluate"),
        *("fly", "evaluate"),
    ]
    here, compared = tmp_path / "here", 0
    for path in sorted(p for p in here.rglob("*") if p.is_file()):
        name = path.relative_to(here).as_posix()
        if path.name.startswith((".", "pipeline")) or "tensorboard" in name:
            continue  # holds the time and place of the run
        assert lab.cat_file(f"lab/demo/{name}") == path.read_bytes(), name
        compared += 1
    assert compared > 35
    assert all(one.skipped for one in pipeline.run(recipe, there, workers=1))
