"""Plans of recipes: every stage, input, output and setting."""

import hashlib
import json
import re
from collections import Counter
from dataclasses import asdict
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dmrl import entry_points, recipe
from dmrl.errors import RecipeError, SettingError
from dmrl.pipeline import recipe_run as pipeline
from dmrl.pipeline.plan import Plan, Step, load_plan
from dmrl.pipeline.stage_signature import signature_of
from dmrl.stages.run import command as run_command

from .chain import HEAD, PICTURES

SMALL = f"""{PICTURES}
[[step]]
stage = "merge"
recordings = ["pictures.mcap", "{{data}}/other.mcap"]
out = "both.mcap"
"""


def load_recipe(folder: Path, text: str) -> Plan:
    """Write a recipe and load its plan."""
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return load_plan(path)


load_shipped = cache(load_plan)


def test_step_keys_become_inputs_or_settings(tmp_path: Path) -> None:
    plan = load_recipe(tmp_path, SMALL)
    assert plan.steps == (
        Step("sketch", "pictures", settings={"images": 2}),
        Step("convert", "pictures.mcap", {"source": "pictures"}),
        Step("merge", "both.mcap", {"recordings": ["pictures.mcap", "{data}/other.mcap"]}),
    )
    assert plan.needs_data and plan.text == SMALL


def test_single_name_for_a_list_input_becomes_a_list(tmp_path: Path) -> None:
    text = 'step = [{ stage = "evaluate", recordings = "{data}/f.mcap", out = "judged" }]'
    assert load_recipe(tmp_path, HEAD + text).steps[0].inputs == {"recordings": ["{data}/f.mcap"]}


def test_step_order_follows_dependencies(tmp_path: Path) -> None:
    _, *blocks = SMALL.split("[[step]]")
    plan = load_recipe(tmp_path, HEAD + "".join(f"[[step]]{block}\n" for block in reversed(blocks)))
    assert list(plan.order.static_order()) == ["pictures", "pictures.mcap", "both.mcap"]


def test_file_named_by_a_setting_is_a_dependency(tmp_path: Path) -> None:
    text = """
    step = [
      { stage = "label", recording = "{data}/f.mcap", out = "l.mcap", camera = { cf1 = "c.toml" } },
      { stage = "calibrate", sources = "{data}/board", board = "9x6", out = "c.toml" },
      { stage = "render", camera = "aideck", images = 2, out = "r.mcap" },
    ]
    """
    plan = load_recipe(tmp_path, HEAD + text)
    assert plan.steps[0].names == ["{data}/f.mcap", "c.toml"]
    order = list(plan.order.static_order())
    assert order.index("c.toml") < order.index("l.mcap")
    with pytest.raises(RecipeError, match=r"label reads d\.toml, which no step writes"):
        load_recipe(tmp_path, HEAD + text.replace('cf1 = "c.toml"', 'cf1 = "d.toml"'))


def test_keys_of_a_step_override_its_recipe_and_preset(tmp_path: Path) -> None:
    path = tmp_path / "rooms.toml"
    path.write_text('kind = "render"\npreset = "himax"\nimages = 7\nseed = 3\n')
    text = f'step = [{{ stage = "render", out = "r.mcap", recipe = "{path}", images = 2 }}]'
    (step,) = load_recipe(tmp_path, HEAD + text).steps
    assert (step.settings["images"], step.settings["seed"]) == (2, 3)
    assert "preset" not in step.settings and "shot_noise" in step.settings
    with pytest.raises(RecipeError, match="is of kind 'render'"):
        load_recipe(tmp_path, HEAD + text.replace('stage = "render"', 'stage = "fly"'))


def test_error_that_ends_with_a_question_mark_gets_no_period(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"1 wrong key: .* Did you mean images\? Fix it$"):
        load_recipe(tmp_path, SMALL.replace("images = 2", "imags = 2"))


def test_argument_of_the_command_line_only_is_refused_in_a_step(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="workers: sketch takes it on the command line alone"):
        load_recipe(tmp_path, SMALL.replace("images = 2", "images = 2\nworkers = 2"))


def test_every_fault_is_named_with_its_step(tmp_path: Path) -> None:
    text = SMALL.replace("images = 2", "imags = 2\nseed = 1.5").replace("source =", "sources =")
    with pytest.raises(RecipeError) as caught:
        load_recipe(tmp_path, "sed = 3\n" + text)
    said = str(caught.value)
    assert "5 wrong keys" in said and "\n" not in said
    for words in (
        "sed: extra inputs are not permitted",
        "step.1.imags: sketch has no such input or setting. Did you mean images?",
        "step.1.seed: input should be a valid integer",
        "step.2.source: is required",
        "step.2.sources: convert has no such input or setting. Did you mean source?",
    ):
        assert words in said


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('stage = "sketch"', 'stage = "skech"', "no stage 'skech'. Did you mean sketch?"),
        ('stage = "sketch"', 'stage = "../sketch"', "no stage '../sketch'"),
        ('stage = "sketch"', 'stage = "info"', "info writes nothing, so it can be no step"),
        ('source = "pictures"', 'source = "picures"', "no step writes. Did you mean pictures?"),
        ('source = "pictures"', "source = 3", "step.2.source: takes one name, a text"),
        ('source = "pictures"', 'source = ["pictures"]', "step.2.source: takes one name"),
        ('source = "pictures"', 'source = "/not/there"', "which is not there"),
        ('source = "pictures"', 'source = "{data}/../../etc"', "which leads out of its folder"),
        ('source = "pictures"', 'source = "pictures/../../x"', "which leads out of its folder"),
        ('source = "pictures"', 'source = "both.mcap"', "in a cycle: "),
        ('source = "pictures"', 'source = "pictures.mcap"', "in a cycle: "),
        ('["pictures.mcap", "{data}/other.mcap"]', "[]", "step.3.recordings: must be a name"),
        ('["pictures.mcap", "{data}/other.mcap"]', "[3]", "step.3.recordings: must be a name"),
        ('out = "pictures.mcap"', 'out = "pictures"', "pictures is written by two steps"),
        ('out = "pictures.mcap"', 'out = "PICTURES"', "PICTURES is written by two steps"),
        ('out = "both.mcap"', 'out = "../both.mcap"', "is no plain name"),
        ('out = "both.mcap"', 'out = "/tmp/both.mcap"', "is no plain name"),
        ('out = "both.mcap"', 'out = "a/both.mcap"', "is no plain name"),
        ('out = "both.mcap"', 'out = ".hidden"', "is no plain name"),
        ('out = "both.mcap"', 'out = ""', "is no plain name"),
        ('out = "both.mcap"', 'out = "a\\u0000b"', "is no plain name"),
        ('out = "both.mcap"', f'out = "{"x" * 300}"', "is no plain name"),
        ('out = "both.mcap"', 'out = "recipe.toml"', "is a name that dmrl uses itself"),
        ('out = "both.mcap"', 'out = "Pipeline.json"', "is a name that dmrl uses itself"),
        ('out = "both.mcap"', 'out = "pictures.partial"', "is a name that dmrl uses itself"),
        ('out = "both.mcap"', 'out = "b"\noptional = 1', "optional: must be true or false"),
        ('out = "both.mcap"', 'out = "b"\nrecipe = "zzz"', "no recipe zzz"),
        ("images = 2", "images = 0", "step.1.images: must be >= 1"),
    ],
)
def test_wrong_step_gives_one_line_error(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in SMALL
    with pytest.raises(RecipeError) as caught:
        load_recipe(tmp_path, SMALL.replace(old, new))
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "stage",
    [
        *("align", "calibrate", "card", "convert", "dataset", "evaluate", "export", "fly", "label"),
        *(
            "likeness",
            "merge",
            "predict",
            "quantize",
            "record",
            "recover",
            "render",
            "sketch",
            "track",
        ),
        *("train", "trim", "verify", "view"),
    ],
)
def test_every_command_that_writes_is_a_step(stage: str) -> None:
    takes = signature_of(stage)
    own = takes.settings
    assert not set(takes.roles) & set(getattr(own, "__dataclass_fields__", {}))


def get_interface(stage: str) -> tuple[Any, ...]:
    """Return inputs, path settings and flags of a stage, from its signature."""
    takes = signature_of(stage)
    roles = {name: (role.many, role.required) for name, role in takes.roles.items()}
    return roles, set(takes.paths), takes.resumes, takes.exclusive


def test_stage_interface_is_read_from_its_run_signature() -> None:
    one, maybe, many = (False, True), (False, False), (True, True)
    few = (True, False)
    train = {"dataset": one, "init": maybe, "teacher": maybe, "unlabelled": few}
    assert get_interface("train") == (train, set(), True, True)
    assert get_interface("calibrate") == ({"sources": many}, {"camera"}, False, False)
    assert get_interface("verify") == ({"folder": one}, {"dataset"}, False, False)
    assert get_interface("merge") == ({"recordings": many}, set(), False, False)
    assert list(signature_of("record").others) == ["robots"]


def test_stage_of_a_plugin_package_is_a_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(recording: Path, out: Path) -> None: ...

    smooth = SimpleNamespace(load=lambda: SimpleNamespace(run=run))
    monkeypatch.setattr(
        entry_points, "find_plugins", lambda group: {"smooth": smooth} if group else {}
    )
    text = 'step = [{ stage = "smooth", recording = "{data}/f.mcap", out = "s.mcap" }]'
    assert load_recipe(tmp_path, HEAD + text).steps[0].inputs == {"recording": "{data}/f.mcap"}
    with pytest.raises(RecipeError, match=r"no stage 'smoth'\. Did you mean smooth\?"):
        load_recipe(tmp_path, HEAD + text.replace("smooth", "smoth"))


def test_arguments_that_are_not_settings_are_checked_too(tmp_path: Path) -> None:
    robots = '{ name = "cf1", uri = "radio://0/80/2M/E7E7E7E7E7" }'
    text = f'{HEAD}step = [{{ stage = "record", out = "f.mcap", robots = [{robots}] }}]'
    assert load_recipe(tmp_path, text).steps[0].settings["robots"][0]["name"] == "cf1"
    for wrong, words in ((", robots = 3", "step.1.robots: "), ("", "step.1.robots: is required")):
        with pytest.raises(RecipeError, match=words):
            load_recipe(tmp_path, text.replace(f", robots = [{robots}]", wrong))


SELF_SUPERVISED = "b48563588f4cb89d31ea5f7cb9756e611f05039ee0a33cb01c6c5c916dba6722"
"""SHA-256 of the 1805 steps that the recipe expands to."""


def step_as_dict(step: Step) -> dict[str, Any]:
    """Return a step as a dictionary, with only the settings that differ from their defaults."""
    takes = step.signature
    assert takes.settings is not None
    usual = recipe.to_json_values(asdict(takes.settings()))
    own = recipe.to_json_values(asdict(recipe.check(step.out, step.settings, takes.settings)))
    settings = {key: value for key, value in own.items() if value != usual[key]}
    return {**asdict(step), "settings": settings}


@pytest.mark.heavy
def test_recipe_self_supervised_expands_to_known_steps() -> None:
    steps = load_shipped("self_supervised").steps
    assert len(recipe.read_text("self_supervised").splitlines()) <= 100
    assert Counter(step.stage for step in steps) == {
        **{"fly": 148, "label": 864, "predict": 748, "dataset": 7, "train": 7},
        **{"evaluate": 30, "view": 1},
    }
    rows = sorted((step_as_dict(step) for step in steps), key=lambda row: str(row["out"]))
    text = json.dumps(rows, sort_keys=True)
    assert hashlib.sha256(text.encode()).hexdigest() == SELF_SUPERVISED


PAGE = Path(__file__).parents[2] / "docs" / "pipelines.md"


PIPELINES_OF_PAGE = re.findall(
    r"```toml\n(kind = .*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
)


@pytest.mark.parametrize("text", PIPELINES_OF_PAGE)
def test_recipes_of_the_page_can_be_loaded(tmp_path: Path, text: str) -> None:
    assert len(load_recipe(tmp_path, text).steps) in (10, 5)


@pytest.mark.parametrize("name", recipe.list_names())
@pytest.mark.heavy
def test_every_shipped_pipeline_can_be_loaded(name: str) -> None:
    if recipe.read(name)["kind"] == "pipeline":
        assert load_shipped(name).steps


@pytest.mark.parametrize("name", ["paper", "published"])
def test_recipes_of_the_paper_have_figures_that_name_their_steps(name: str) -> None:
    assert load_shipped(name).pictured


@pytest.mark.parametrize("name", ["adapt", "adapt_own"])
def test_adapting_calibrates_on_images_that_it_does_not_learn_from(name: str) -> None:
    (step,) = (
        one
        for one in load_shipped(name).steps
        if "recordings" in one.inputs and "val" in one.settings
    )
    held = [one for one in step.inputs["recordings"] if fnmatch(one, step.settings["val"])]
    assert held == ["held.mcap"] and step.settings["split"] == "none"


def test_figure_of_an_unknown_output_is_a_fault(tmp_path: Path) -> None:
    figure = '[[figure]]\ntitle = "Losses"\nshows = "losses"\nof = ["model"]\n'
    with pytest.raises(RecipeError, match=r"figure\.1\.of: no step writes model"):
        load_recipe(tmp_path, SMALL + figure)


@pytest.mark.heavy
def test_data_of_optional_steps_need_not_be_there(tmp_path: Path) -> None:
    step = '[[step]]\nstage = "convert"\nsource = "{data}/none"\nout = "a.mcap"\n'
    text = HEAD + '[[step]]\nstage = "sketch"\nimages = 1\nout = "pictures"\n' + step
    (tmp_path / "data").mkdir()
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(SettingError, match=r"no .*none\. Check --data"):
        pipeline.run(tmp_path / "mine.toml", tmp_path / "out", tmp_path / "data")
    (tmp_path / "mine.toml").write_text(text + "optional = true\n")
    done = pipeline.run(tmp_path / "mine.toml", tmp_path / "out", tmp_path / "data")
    assert [one.left_out for one in done] == [False, True]


@pytest.mark.heavy
def test_recipe_with_figures_redraws_its_report_on_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sketch = '[[step]]\nstage = "sketch"\nimages = 3\nout = "pictures"\n'
    convert = '[[step]]\nstage = "convert"\nsource = "pictures"\nout = "a.mcap"\n'
    shown = '[[figure]]\ntitle = "Three"\nshows = "numbers"\n'
    rows = 'rows = [{ what = "x", of = "pictures/labels.csv", at = "y" }]\n'
    (tmp_path / "mine.toml").write_text(HEAD + sketch + convert + shown + rows)
    page = tmp_path / "out" / "report.html"
    run_command(str(tmp_path / "mine.toml"), out=tmp_path / "out")
    first = page.stat().st_mtime_ns
    assert "Three</h3>" in page.read_text() and str(page) in capsys.readouterr().out
    run_command(str(tmp_path / "mine.toml"), out=tmp_path / "out")
    assert page.stat().st_mtime_ns == first
    text = (HEAD + sketch + convert + shown + rows).replace("images = 3", "images = 4")
    (tmp_path / "mine.toml").write_text(text)
    run_command(str(tmp_path / "mine.toml"), out=tmp_path / "out")
    assert page.stat().st_mtime_ns > first
