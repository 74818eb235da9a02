"""A run whose recipe has figures ends with a page; nothing is drawn again for nothing."""

from pathlib import Path

import pytest

from dmrl.stages import run

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


@pytest.mark.heavy
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
    # A page that was not written by dmrl is left alone, so it goes first.
    page.unlink()
    run.command(str(recipe), out=tmp_path / "out", workers=1)
    assert "WORDS" in page.read_text() and "2 of 2 steps" in capsys.readouterr().err
    # Figures alone have changed: no step is run, the page is another.
    recipe.write_text(RECIPE.replace("WORDS", "last words"))
    run.command(str(recipe), out=tmp_path / "out", workers=1)
    assert "last words" in page.read_text() and "2 of 2 steps" in capsys.readouterr().err
