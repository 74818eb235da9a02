"""With hostile inputs, every command writes only OUT and temporary files.

The tree around OUT is the same before and after, and Python's audit events show no other write.
"""

import shutil
from pathlib import Path

import pytest

from dmrl.cli import COMMANDS

from .box import EACH, Box, run_command

pytestmark = pytest.mark.heavy

HOSTILE: dict[str, tuple[tuple[str, ...], ...]] = {
    "demo": (("--out", "IN/bad.mcap"), ("--out", "IN/link")),
    "run": (("IN/each.toml", "--out", "OUT/run"), ("IN/link.toml", "--out", "OUT/run")),
    "render": (("IN/each.toml", "OUT/render.mcap"), ("IN/link", "OUT/render.mcap")),
    "likeness": (("IN/pictures", "OUT/like.toml"), ("IN/bad.mcap", "OUT/like.toml")),
    "sketch": (("IN/link", "--images", "1"), ("OUT/sketch", "--images", "1")),
    "fly": (("IN/each.toml", "OUT/fly.mcap"),),
    "convert": (
        ("IN/bad.mcap", "OUT/csv", "--to", "csv"),
        ("IN/bad.mcap", "OUT/parquet", "--to", "parquet"),
        ("IN/bad.mcap", "OUT/ros", "--to", "ros2"),
        ("IN/logs", "OUT/logs.mcap", "--from", "csv"),
        ("IN/logs", "OUT/columns.mcap", "--columns", "IN/columns.toml"),
        ("IN/logs", "OUT/cfclient.mcap", "--from", "cfclient"),
        ("IN/pictures", "OUT/pictures.mcap", "--from", "images"),
        ("IN/link", "OUT/link.mcap"),
    ),
    "record": (("OUT/record.mcap", "--robot", "../../x=udp://127.0.0.1:1"),),
    "fake-drone": (("--flight", "IN/bad.mcap", "--uri", "udp://127.0.0.1:0x"),),
    "calibrate": (("IN/bad.mcap", "OUT/camera.toml"),),
    "align": (("IN/bad.mcap", "OUT/align.mcap"),),
    "label": (("IN/bad.mcap", "OUT/label.mcap"), ("IN/folder", "OUT/labels")),
    "dataset": (
        ("IN/bad.mcap", "OUT/set"),
        ("IN/bad.mcap", "OUT/sets", "--parquet"),
        ("IN/other.mcap", "OUT/cards", "--add"),
    ),
    "card": (("IN/bad.mcap",), ("OUT/cards",)),
    "train": (("OUT/cards", "OUT/run", "--epochs", "1"), ("IN/bad.mcap", "OUT/run")),
    "predict": (
        ("IN/model", "IN/bad.mcap", "OUT/predicted.mcap"),
        ("dmrl-nano", "IN/bad.mcap", "OUT/nano.mcap"),
    ),
    "track": (("IN/bad.mcap", "OUT/track.mcap"),),
    "evaluate": (("IN/bad.mcap",), ("IN/bad.mcap", "--plots", "OUT/judged")),
    "score": (
        ("OUT/score.json", "--detected", "IN/bad.mcap"),
        ("OUT/score.json", "--labels", "IN/link", "--scenes", "IN/bad.mcap"),
    ),
    "quantize": (("IN/model", "OUT/cards", "OUT/int8"), ("dmrl-nano", "OUT/cards", "OUT/int8")),
    "export": (("IN/model", "OUT/exported"), ("IN/link", "OUT/exported")),
    "verify": (("IN/model",), ("IN/link",)),
    "view": (("IN/bad.mcap", "--save", "OUT/view.rrd"),),
    "doctor": ((),),
    "report": (("IN", "OUT/page.html"), ("OUT/cards",)),
    "info": (("IN/bad.mcap",), ("IN/bad.mcap", "--json"), ("IN/link",)),
    "check": (("IN/bad.mcap",), ("IN/bad.mcap", "--json"), ("IN/link",)),
    "index": (("OUT/found",), ("IN/link",)),
    "find": (("true", "OUT/found"), ("true", "IN/link"), ("true", "IN")),
    "recover": (("IN/bad.mcap", "OUT/recovered.mcap"), ("IN/link", "OUT/recovered2.mcap")),
    "merge": (("IN/bad.mcap", "IN/other.mcap", "OUT/merged.mcap"),),
    "trim": (
        ("IN/bad.mcap", "OUT/trimmed.mcap"),
        ("IN/link", "OUT/trimmed2.mcap"),
    ),
}
"""Arguments of every command: inputs with hostile names, and links to the victim's files."""


def test_every_command_is_given_hostile_inputs() -> None:
    assert HOSTILE.keys() == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_writes_elsewhere_for_hostile_inputs(
    name: str, inputs: Path, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(inputs, box.root / "in", dirs_exist_ok=True)
    shutil.move(box.root / "in" / "cards", box.out / "cards")
    shutil.copytree(box.root / "in" / "folder", box.out / "found")
    shutil.copy(box.root / "in" / "bad.mcap", box.out / "found" / "bad.mcap")
    (box.root / "in" / "link").symlink_to(box.victim / "keep")
    (box.root / "in" / "link.toml").symlink_to(box.victim)
    for words in HOSTILE[name]:
        given = [
            w.replace("IN", str(box.root / "in")).replace("OUT", str(box.out))
            if w.startswith(("IN", "OUT"))
            else w
            for w in words
        ]
        run_command(box, capsys, name, *given)
    pages = [
        p.read_text()
        for p in (box.out / "page.html", box.out / "cards" / "report.html")
        if p.is_file()
    ]
    assert not any("<img src=x" in page or "<script" in page for page in pages)


@pytest.mark.parametrize(
    ("words", "links"),
    [
        (("trim", "IN/bad.mcap", "OUT/x.mcap"), ("x.mcap", "x.mcap.partial")),
        (("recover", "IN/bad.mcap", "OUT/x.mcap"), ("x.mcap", "x.mcap.partial")),
        (("convert", "IN/bad.mcap", "OUT/x", "--to", "csv"), ("x", "x.partial")),
        (("dataset", "IN/bad.mcap", "OUT/x"), ("x", "x.partial")),
        (("sketch", "OUT/x", "--images", "1"), ("x", "x.partial")),
        (("fly", "fly_in_view", "OUT/x", "--duration-s", "1"), ("x", "x.partial")),
        (("export", "IN/model", "OUT/x"), ("x", "x.partial")),
        (("evaluate", "IN/bad.mcap", "--plots", "OUT/x"), ("x", "x.partial")),
        (("report", "OUT/cards"), ("cards/report.html", "cards/report.html.partial")),
        (("card", "OUT/cards"), ("cards/README.md.partial", "cards/figures/depth.png")),
        (("run", "IN/one.toml", "--out", "OUT/x"), ("x/recipe.toml.partial", "x/unfinished")),
        (("run", "IN/one.toml", "--out", "OUT/x"), ("x/pipeline.json.partial", "x/s.partial")),
        (("record", "OUT/x", "--robot", "cf1=udp://127.0.0.1:1"), ("x", "x.partial")),
        (("train", "OUT/cards", "OUT/x", "--epochs", "1"), ("x", "x.partial")),
    ],
    ids=lambda words: words[0],
)
@pytest.mark.parametrize("target", ["victim", "victim/keep"])
def test_links_in_out_are_not_written_through(
    words: tuple[str, ...], links: tuple[str, ...], target: str, inputs: Path, box: Box,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    shutil.copytree(inputs, box.root / "in", dirs_exist_ok=True)
    shutil.move(box.root / "in" / "cards", box.out / "cards")
    one = EACH.replace(
        '"../../victim/x", "/tmp/victim", "..", "a\\u001b[2J", "recipe.toml", "x"', '"s"'
    )
    (box.root / "in" / "one.toml").write_text(one)
    given = [w.replace("IN", str(box.root / "in")).replace("OUT", str(box.out)) for w in words]
    for link in links:
        path = box.out / link
        path.parent.mkdir(exist_ok=True)
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.symlink_to(box.root / target)
        if words[0] == "run":
            (path.parent / "pipeline.json").write_text('{"begun": {}, "done": {}, "hashes": {}}')
        run_command(box, capsys, *given)
        if path.is_symlink():
            path.unlink()


@pytest.mark.parametrize("name", ["../../victim/x", "{victim}/x", "recipe.toml", "..", "a/../../x"])
def test_step_of_a_recipe_writes_only_in_the_pipeline_folder(
    name: str, box: Box, capsys: pytest.CaptureFixture[str]
) -> None:
    out = name.replace("{victim}", str(box.victim))
    recipe = box.root / "in" / "recipe.toml"
    step = '[[step]]\nstage = "sketch"\nimages = 1\nout = '
    recipe.write_text(f'kind = "pipeline"\n{step}"{out}"\n')
    assert run_command(box, capsys, "run", recipe, "--out", box.out / "a") == 1
    assert list(box.out.iterdir()) == []
    recipe.write_text(f'kind = "pipeline"\n{step}"honest"\n')
    assert (
        run_command(box, capsys, "run", recipe, "--out", box.out / "a") == 0
    )  # a valid name succeeds
