"""The figures of a recipe come first in the report, drawn from the outputs of its steps."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from dmrl.html_report import build_report, collect_outputs
from dmrl.images.codec import encode_png
from dmrl.messages import message_class
from dmrl.recording import Provenance, RecordingWriter

pytestmark = pytest.mark.heavy

RECIPE = """
kind = "pipeline"
title = "The paper, again"

[[figure]]
title = "In numbers"
shows = "numbers"
rows = [
  { what = "px", published = "4.3", of = "JUDGED", at = "overall.median_px.value", form = ".1f" },
  { what = "not there", of = "JUDGED", at = "overall.nothing" },
]

[[figure]]
title = "Both losses"
shows = "losses"
of = ["model"]
named = ["<b>ours</b>"]
words = "published: lower"

[[figure]]
title = "Circles"
shows = "images"
of = ["judged"]

[[figure]]
title = "Chip"
shows = "maps"
of = ["float.mcap", "chip.mcap", "absent.mcap"]
named = ["float", "chip", "absent"]
""".replace("JUDGED", "judged/evaluation.json")


def write_maps(path: Path, factor: float) -> None:
    """Write an image and its maps, scaled by a factor."""
    grid = np.linspace(0.1, 0.9, 12, dtype="<f4").reshape(3, 4) * factor
    picture = encode_png(np.zeros((24, 32, 3), np.uint8))
    with RecordingWriter(path, Provenance("test", {})) as sink:
        sink.write(
            5, "/cf1/camera/image", message_class("CompressedImage")(data=picture, format="png")
        )
        fields = {"rows": 3, "cols": 4, "channels": ("confidence", "depth_m"), "stride_px": 8}
        data = np.stack((grid, 2 * grid)).tobytes()
        sink.write(5, "/cf1/detections/grid", message_class("GridMap")(data=data, **fields))


@pytest.fixture
def pipeline(outputs: Path) -> Path:
    """Return the outputs of a recipe with figures."""
    (outputs / "recipe.toml").write_text(RECIPE)
    about = json.loads((outputs / "model/model.json").read_text())
    about["training"] = {
        "history": [{"loss": 2.0, "confidence_loss": 1.0, "depth_loss": 1.0 / k} for k in (1, 2)]
    }
    (outputs / "model/model.json").write_text(json.dumps(about))
    picture = encode_png(np.full((20, 30, 3), 90, np.uint8))
    (outputs / "judged/circles.png").write_bytes(picture)
    write_maps(outputs / "float.mcap", 1.0)
    write_maps(outputs / "chip.mcap", 0.5)
    return outputs


def test_a_recipes_figures_come_first_in_its_order(pipeline: Path) -> None:
    html = build_report(collect_outputs(pipeline))
    story = html[html.index("The paper, again</h2>") : html.index("Detections</h2>")]
    places = [story.index(f"<h3>{t}") for t in ("In numbers", "Both losses", "Circles", "Chip")]
    assert places == sorted(places)
    assert "cannot be drawn" not in story
    assert ">4.3<" in story and ">0.5<" in story and ">-<" in story
    assert story.count("<svg") == 2 and "<b>ours" not in story and "published: lower" in story
    assert story.count("data:image/") == 2


def test_maps_show_their_difference_from_the_first(pipeline: Path) -> None:
    html = build_report(collect_outputs(pipeline))
    grid = np.linspace(0.1, 0.9, 12)
    assert "against float" in html and ">1.000<" in html
    assert f"{np.abs(grid - 0.5 * grid).mean():.4f}" in html
    assert f"{2 * np.abs(grid - 0.5 * grid).mean():.4f}" in html
    assert ">absent<" not in html  # an optional step that was not run


def test_figure_that_cannot_be_drawn_shows_its_reason(pipeline: Path) -> None:
    (pipeline / "model/model.json").write_text("{")
    (pipeline / "judged/circles.png").write_bytes(b"no picture")
    (pipeline / "chip.mcap").write_bytes(b"no recording")
    html = build_report(collect_outputs(pipeline))
    story = html[html.index("The paper, again</h2>") :]
    assert story.count("cannot be drawn") == 2 and "circles.png" in story
    assert ">0.5<" in story


def test_figure_sources_outside_the_folder_are_not_shown(pipeline: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.json"
    secret.write_text('{"overall": "hidden words"}')
    recipe = RECIPE.replace("judged/evaluation.json", str(secret)).replace(".nothing", "")
    (pipeline / "recipe.toml").write_text(recipe)
    assert "hidden words" not in build_report(collect_outputs(pipeline))


def test_invalid_recipe_is_reported_on_the_report(pipeline: Path) -> None:
    (pipeline / "recipe.toml").write_text("[[figure]]\nshows = 3\n")
    html = build_report(collect_outputs(pipeline))
    assert "recipe.toml" in html[html.index("Unreadable files</h2>") :]
    assert "Detections</h2>" in html


def test_unusable_figure_sources_show_a_reason(pipeline: Path) -> None:
    """The sources are a missing file, a recording without images, and a folder."""
    (pipeline / "chip.mcap").unlink()
    with RecordingWriter(pipeline / "chip.mcap", Provenance("test", {})) as sink:
        fields = {"rows": 1, "cols": 1, "channels": ("confidence", "depth_m"), "stride_px": 8}
        grid = message_class("GridMap")(data=np.ones(2, "<f4").tobytes(), **fields)
        sink.write(5, "/cf1/detections/grid", grid)
    (pipeline / "judged" / "pipe.json").mkdir()
    maps_of = '[[figure]]\ntitle = "Maps"\nshows = "maps"\nof = ["{}"]\n'
    other = RECIPE.replace("judged/evaluation.json", "judged/pipe.json")
    more = maps_of.format("absent.mcap") + maps_of.format("chip.mcap")
    (pipeline / "recipe.toml").write_text(other + more)
    shown = build_report(collect_outputs(pipeline))
    assert "judged/pipe.json is not a file" in shown
    assert shown.count("cannot be drawn") >= 3


def test_figures_that_are_no_tables_are_named_on_the_page(pipeline: Path) -> None:
    (pipeline / "recipe.toml").write_text('kind = "pipeline"\nfigure = 3\n')
    assert "must be [[figure]] tables" in collect_outputs(pipeline).unread["recipe.toml"]


def test_results_stand_in_the_order_of_the_recipe(outputs: Path) -> None:
    shutil.copytree(outputs / "judged", outputs / "another")
    assert list(collect_outputs(outputs).documents_of_kind("evaluations")) == ["another", "judged"]
    steps = '[[step]]\nout = "judged"\n[[step]]\nout = "another"\n'
    (outputs / "recipe.toml").write_text(f'kind = "pipeline"\n{steps}')
    assert list(collect_outputs(outputs).documents_of_kind("evaluations")) == ["judged", "another"]
