"""What the pages say is so: generated parts are fresh, commands parse, links lead somewhere."""

import re
import runpy
import shlex
from pathlib import Path

import pytest

from dmrl.cli import COMMANDS, app
from dmrl.estimation.gate import EXPECTED_SHARE

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(ROOT.glob("docs/*.md"))]
HAND_WRITTEN = [page for page in PAGES if page.name != "commands.md"]
RECIPES = sorted(ROOT.glob("recipes/*.toml"))


def command_lines(page: Path) -> list[str]:
    """``dmrl ...`` in the shell blocks of a page, or in a recipe up to two spaces."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".toml":
        return re.findall(r"^# (dmrl .*?)(?:  .*)?$", text, re.MULTILINE)
    blocks = re.findall(r"```(?:sh|console)\n(.*?)```", text, re.DOTALL)
    joined = "\n".join(blocks).replace("\\\n", " ")
    return re.findall(r"^(?:\$ )?(dmrl .*)", joined, re.MULTILINE)


SHELL = [(p, line) for p in [*HAND_WRITTEN, *RECIPES] for line in command_lines(p)]
QUOTED = [
    (page, line)
    for page in HAND_WRITTEN
    for line in re.findall(r"`(dmrl [a-z][^`]*)`", page.read_text(encoding="utf-8"))
]


@pytest.mark.parametrize(("page", "line"), SHELL, ids=lambda v: getattr(v, "name", v))
def test_every_command_line_can_be_typed_as_it_stands(page: Path, line: str) -> None:
    app.parse_args(shlex.split(line, comments=True)[1:], exit_on_error=False, print_error=False)


@pytest.mark.parametrize(("page", "line"), QUOTED, ids=lambda v: getattr(v, "name", v))
def test_every_command_and_flag_in_the_text_exists(page: Path, line: str) -> None:
    words = shlex.split(line)
    name = words[1]
    assert name in COMMANDS, f"{page.name}: {line}"
    arguments = app[name].assemble_argument_collection()
    flags = {flag for argument in arguments for flag in argument.names} | {"--help"}
    assert {word for word in words[2:] if word.startswith("--")} <= flags


def test_the_readme_shows_commands() -> None:
    assert len(command_lines(ROOT / "README.md")) >= 3


@pytest.mark.parametrize("page", ["README.md", "docs/commands.md", "docs/formats.md"])
def test_generated_parts_are_fresh(page: str) -> None:
    made = runpy.run_path(str(ROOT / "docs/build.py"))["pages"]()[ROOT / page]
    assert (ROOT / page).read_text(encoding="utf-8") == made, "run: make docs"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_to_files_of_the_repository_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8"))
    inside = [t for t in targets if not t.startswith(("http://", "https://"))]
    assert [t for t in inside if not (page.parent / t).exists()] == []


def test_the_two_set_up_commands_are_targets_of_make() -> None:
    wanted = set(re.findall(r"\bmake ([a-z-]+)", " ".join(_code(page) for page in HAND_WRITTEN)))
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {"demo", "test"} <= wanted <= targets


def _code(page: Path) -> str:
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"```sh\n(.*?)```|`([^`\n]+)`", text, re.DOTALL)
    return " ".join(block or quoted for block, quoted in found)


def test_help_and_page_agree_with_the_gate_on_how_many_positions_are_bad() -> None:
    share = f"{EXPECTED_SHARE:.1%}".replace("%", " %")
    for name in ("commands.md", "labelling.md"):
        text = re.sub(r"[\s│]+", " ", (ROOT / "docs" / name).read_text(encoding="utf-8"))
        assert f"{share} is expected to be bad" in text or f"{share} are expected to be bad" in text
