import json
from pathlib import Path

import pytest

from dmrl import pipeline
from dmrl.errors import DmrlError, RecipeError, SettingError, SourceError
from dmrl.evaluation.report import report

SMALL = """
kind = "pipeline"

[[step]]
stage = "sketch"
out = "pictures"
settings = { images = 10 }

[[step]]
stage = "convert"
inputs = ["pictures"]
out = "pictures.mcap"

[[step]]
stage = "dataset"
inputs = ["pictures.mcap"]
out = "dataset"

[[step]]
stage = "train"
inputs = ["dataset"]
out = "model"
settings = { epochs = 1 }

[[step]]
stage = "predict"
inputs = ["model", "pictures.mcap"]
out = "predictions.mcap"

[[step]]
stage = "evaluate"
inputs = ["predictions.mcap"]
out = "evaluation"
settings = { draws = 20 }
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_pipeline_runs_every_step_and_then_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = write(tmp_path, SMALL)
    done = pipeline.run(recipe, tmp_path / "out")
    assert [d.stage for d in done] == [
        "sketch",
        "convert",
        "dataset",
        "train",
        "predict",
        "evaluate",
    ]
    assert not any(d.skipped for d in done)
    report(done)
    table = capsys.readouterr().out
    assert "evaluation" in table
    assert "error-violins.png" in table
    again = pipeline.run(recipe, tmp_path / "out")
    assert all(d.skipped for d in again)
    report(again, as_json=True)
    assert json.loads(capsys.readouterr().out)["evaluations"]["evaluation"]["against"] == "truth"


def test_a_pipeline_goes_on_where_it_stopped(tmp_path: Path) -> None:
    recipe = write(tmp_path, SMALL.split('[[step]]\nstage = "dataset"')[0])
    pipeline.run(recipe, tmp_path / "out")
    (tmp_path / "out" / "pictures.mcap").unlink()
    done = pipeline.run(recipe, tmp_path / "out")
    assert [(d.stage, d.skipped) for d in done] == [("sketch", True), ("convert", False)]


def test_a_training_may_go_on_from_the_model_of_another(tmp_path: Path) -> None:
    refine = """
[[step]]
stage = "train"
inputs = ["dataset", "model"]
out = "refined"
settings = { epochs = 1, learning_rate = 1e-9, final_learning_rate = 0.0 }
"""
    first = SMALL.split('\n[[step]]\nstage = "predict"')[0]
    pipeline.run(write(tmp_path, first + refine), tmp_path / "out")
    made = json.loads((tmp_path / "out" / "refined" / "provenance.json").read_text())
    assert [source["name"] for source in made["inputs"]] == ["dataset", "model"]
    with pytest.raises(RecipeError, match=r"\(train\) has 3 inputs, not 1 or 2"):
        wrong = refine.replace('"model"]', '"model", "model"]')
        pipeline.run(write(tmp_path, first + wrong), tmp_path / "again")


def test_another_recipe_does_not_reuse_the_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    pipeline.run(write(tmp_path, SMALL.split('\n[[step]]\nstage = "convert"')[0]), out)
    with pytest.raises(SettingError, match="made by another recipe"):
        pipeline.run(write(tmp_path, SMALL), out)
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").touch()
    with pytest.raises(SettingError, match="is not empty"):
        pipeline.run(write(tmp_path, SMALL), foreign)


def test_data_that_does_not_ship_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="--data DIR"):
        pipeline.run("published", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_was_made_of_other_data_is_not_reused(tmp_path: Path) -> None:
    log = '[[step]]\nstage = "convert"\ninputs = ["{data}/a.csv"]\nout = "a.mcap"\n'
    recipe, out = write(tmp_path, 'kind = "pipeline"\n' + log), tmp_path / "out"
    for name in ("wrong", "mine", "yours"):
        (tmp_path / name).mkdir()
        if name != "wrong":
            (tmp_path / name / "a.csv").write_text("Timestamp,gyro.z\n0,1\n10,2\n")
    with pytest.raises(SourceError):
        pipeline.run(recipe, out, tmp_path / "wrong")
    assert not pipeline.run(recipe, out, tmp_path / "mine")[0].skipped
    assert pipeline.run(recipe, out, tmp_path / "mine")[0].skipped
    with pytest.raises(SettingError, match=r"made of the data in .*mine\. Name another folder"):
        pipeline.run(recipe, out, tmp_path / "yours")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('inputs = ["pictures"]', 'inputs = ["picures"]', "step 2 (convert) reads picures"),
        ('inputs = ["model", "pictures.mcap"]', 'inputs = ["model"]', "has 1 inputs, not 2"),
        ('out = "evaluation"', 'out = "dataset"', "step 6 writes dataset again"),
        ('stage = "sketch"', 'stage = "skech"', "no stage 'skech'"),
    ],
)
def test_a_wrong_step_is_named_before_anything_is_done(
    tmp_path: Path, old: str, new: str, complaint: str
) -> None:
    with pytest.raises(RecipeError, match=complaint.replace("(", r"\(").replace(")", r"\)")):
        pipeline.run(write(tmp_path, SMALL.replace(old, new)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_three_wrong_keys_are_all_named(tmp_path: Path) -> None:
    text = SMALL.replace("images = 10", "imags = 10").replace("epochs = 1", 'epochs = "one"')
    with pytest.raises(RecipeError) as caught:
        pipeline.run(write(tmp_path, "sed = 1\n" + text), tmp_path / "out")
    assert "3 wrong keys" in str(caught.value)
    for key in ("sed:", "step.1.settings.imags:", "step.4.settings.epochs:"):
        assert key in str(caught.value)


def test_an_optional_step_that_fails_is_left_out_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        SMALL.split('[[step]]\nstage = "dataset"')[0]
        + """
[[step]]
stage = "evaluate"
inputs = ["pictures.mcap"]
out = "evaluation"
optional = true
"""
    )
    done = pipeline.run(write(tmp_path, text), tmp_path / "out")
    assert not done[-1].out.exists()
    assert "evaluate: left out." in capsys.readouterr().err
    report(done)
    with pytest.raises(DmrlError, match="has no detections"):
        recipe = write(tmp_path, text.replace("optional = true", ""))
        pipeline.run(recipe, tmp_path / "again")
