"""A repeated run of a recipe repeats steps and redraws the report only after changes."""

import json
from pathlib import Path

import pytest

from dmrl.pipeline.runner import Runner
from dmrl.stages import run

pytestmark = pytest.mark.heavy

RECIPE = """
kind = "pipeline"
title = "Few"

[[step]]
stage = "sketch"
images = 2
out = "pictures"

[[step]]
stage = "convert"
source = "pictures"
out = "pictures.mcap"

[[figure]]
title = "WORDS"
shows = "numbers"
rows = [{ what = "px", published = "one", of = "pictures/none.json", at = "nothing" }]
"""


def test_a_page_is_drawn_again_when_a_step_or_a_figure_has_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, page = tmp_path / "few.toml", tmp_path / "out/report.html"
    recipe.write_text(RECIPE)
    run.command(str(recipe), out=tmp_path / "out", workers=1)
    assert "WORDS" in page.read_text() and f"{page}: open it" in capsys.readouterr().out
    page.write_text("untouched")
    run.command(str(recipe), out=tmp_path / "out", workers=1)
    assert page.read_text() == "untouched"
    # A page that dmrl did not write is never replaced, so remove it.
    page.unlink()
    run.command(str(recipe), out=tmp_path / "out", workers=1)
    assert "WORDS" in page.read_text() and "2 of 2 steps" in capsys.readouterr().err
    # Only a figure has changed: no step is run, but the page is redrawn.
    recipe.write_text(RECIPE.replace("WORDS", "last words"))
    run.command(str(recipe), out=tmp_path / "out", workers=1)
    assert "last words" in page.read_text() and "2 of 2 steps" in capsys.readouterr().err


def test_replaced_outputs_are_kept_and_reported_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, out = tmp_path / "few.toml", tmp_path / "out"
    steps = RECIPE[: RECIPE.index("[[figure]]")].replace('title = "Few"\n', "")
    recipe.write_text(steps)
    run.command(str(recipe), out=out, dry_run=True)
    assert not out.exists() and capsys.readouterr().out.count("make") == 2
    run.command(str(recipe), out=out, workers=1)
    first = {path: path.read_bytes() for path in sorted(out.glob("**/*.*")) if path.is_file()}
    for images in (3, 4):
        recipe.write_text(steps.replace("images = 2", f"images = {images}"))
        capsys.readouterr()
        run.command(str(recipe), out=out, dry_run=True, as_json=True)
        output = json.loads(capsys.readouterr().out)["steps"]
        assert [one["action"] for one in output] == ["replace", "replace"]
        assert output[0]["reason"] == f"images {images - 1} -> {images}"
        assert output[1]["reason"] == "pictures is made again"
        run.command(str(recipe), out=out, workers=1)
        assert f"pictures is replaced: images {images - 1}" in capsys.readouterr().err
    kept = out / "previous"
    assert sorted(path.name for path in kept.iterdir()) == sorted(
        [
            "pictures",
            "pictures.2",
            "pictures.mcap",
            "pictures.2.mcap",
            "recipe.toml",
            "recipe.2.toml",
        ]
    )
    again = {
        path: (kept / path.relative_to(out)).read_bytes()
        for path in first
        if path.name != "pipeline.json"
    }
    assert again == {
        path: content for path, content in first.items() if path.name != "pipeline.json"
    }


def test_a_run_that_makes_no_output_keeps_the_recipe_and_leaves_no_empty_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, out = tmp_path / "few.toml", tmp_path / "out"
    steps = RECIPE[: RECIPE.index("[[figure]]")].replace('title = "Few"\n', "")
    recipe.write_text(steps)
    run.command(str(recipe), out=out, workers=1)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Runner, "_finish_steps", stop)
    recipe.write_text(steps.replace("images = 2", "images = 3"))
    with pytest.raises(KeyboardInterrupt):
        run.command(str(recipe), out=out, workers=1)
    assert (out / "recipe.toml").read_text() == steps
    assert not (out / "previous").exists()
    monkeypatch.undo()
    run.command(str(recipe), out=out, workers=1)
    assert (out / "recipe.toml").read_text() == recipe.read_text()
    assert not (out / "unfinished").exists()


def test_output_modified_by_hand_is_reported_and_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, out = tmp_path / "few.toml", tmp_path / "out"
    recipe.write_text(RECIPE[: RECIPE.index("[[figure]]")].replace('title = "Few"\n', ""))
    run.command(str(recipe), out=out, workers=1)
    (out / "pictures/labels.csv").write_text("mine")
    capsys.readouterr()
    run.command(str(recipe), out=out, dry_run=True)
    assert "it was changed after the run" in capsys.readouterr().out
    run.command(str(recipe), out=out, workers=1)
    assert (out / "previous/pictures/labels.csv").read_text() == "mine"
