"""The examples in the help of the commands parse and run."""

import shlex
import shutil
import tomllib
from importlib.resources import files
from pathlib import Path

import pytest

from dmrl.cli import COMMANDS, app
from dmrl.terminal.help_pages import read_examples

EXAMPLES = tomllib.loads(files("dmrl.stages").joinpath("examples.toml").read_text())
LINES = [line for lines in EXAMPLES.values() for line in lines]
NEEDS = {
    "demo": "minutes; make demo runs it",
    "render": "Blender",
    "likeness": "Blender",
    "fake-drone": "a recorder that listens",
    "record": "drones",
    "view seen.mcap": "a window",
    "calibrate": "pictures of a board, or flights that are long enough",
}
"""Commands whose examples are only parsed, and what running them would need."""
RECIPE = """
kind = "pipeline"

[[step]]
stage = "sketch"
images = 4
out = "pictures"

[[step]]
stage = "convert"
source = "pictures"
out = "pictures.mcap"
"""


def test_every_command_has_two_examples() -> None:
    assert {name: len(read_examples(name)) for name in COMMANDS} == dict.fromkeys(COMMANDS, 2)
    assert set(EXAMPLES) == set(COMMANDS)


@pytest.mark.parametrize("line", LINES)
def test_an_example_can_be_typed_as_it_stands(line: str) -> None:
    app.parse_args(shlex.split(line)[1:], exit_on_error=False, print_error=False)


def find_need(line: str) -> str:
    """Return what a command line needs that the test lacks; empty if it can run."""
    return next((why for name, why in NEEDS.items() if line == f"dmrl {name}"), "") or next(
        (why for name, why in NEEDS.items() if line.split()[1] == name), ""
    )


@pytest.mark.heavy
@pytest.mark.timeout(1800)
def test_the_examples_run_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("few.toml").write_text(RECIPE, encoding="utf-8")
    done = []
    for line in LINES:
        if find_need(line):
            continue
        if line.startswith("dmrl recover") and not Path("torn.mcap").exists():
            shutil.copy("flight.mcap", "torn.mcap")
            with Path("torn.mcap").open("r+b") as stream:
                stream.truncate(stream.seek(0, 2) // 2)
        status = app(shlex.split(line)[1:], result_action="return_value")
        done.append((line, status))
    assert [line for line, status in done if status not in (None, 0)] == []
    assert capsys.readouterr().out
