"""Documentation: generated parts are current, commands parse, links resolve."""

import re
import runpy
import shlex
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from dmrl.cli import COMMANDS, app
from dmrl.estimation.model.gate import BAD_SHARE
from dmrl.installation import EXTRAS

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(ROOT.glob("docs/*.md")),
]
HAND_WRITTEN = [page for page in PAGES if page.name != "commands.md"]
RECIPES = sorted(ROOT.glob("recipes/**/*.toml"))


def find_command_lines(page: Path) -> list[str]:
    """Return the ``dmrl`` command lines in a page's shell blocks or a recipe's comments.

    In a recipe, two spaces end the command.
    """
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".toml":
        return re.findall(r"^# (dmrl .*?)(?:  .*)?$", text, re.MULTILINE)
    blocks = re.findall(r"```(?:sh|console)\n(.*?)```", text, re.DOTALL)
    joined = "\n".join(blocks).replace("\\\n", " ")
    return re.findall(r"^(?:\$ )?(dmrl .*)", joined, re.MULTILINE)


SHELL = [(p, line) for p in [*HAND_WRITTEN, *RECIPES] for line in find_command_lines(p)]
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
    assert len(find_command_lines(ROOT / "README.md")) >= 3


@pytest.fixture(scope="module")
def generated_pages() -> dict[Path, str]:
    """Return the pages as `make docs` would write them."""
    return dict(runpy.run_path(str(ROOT / "docs/build.py"))["pages"]())


@pytest.mark.parametrize(
    "page", ["docs/index.md", "docs/commands.md", "docs/formats.md", "dmrl/api/settings.pyi"]
)
@pytest.mark.heavy
def test_generated_parts_are_fresh(page: str, generated_pages: dict[Path, str]) -> None:
    assert (ROOT / page).read_text(encoding="utf-8") == generated_pages[ROOT / page], (
        "run: make docs"
    )


def find_links(page: Path) -> list[tuple[Path, str]]:
    """Return the files that a page links to, each with the anchor of a heading, or ""."""
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    inside = [t.partition("#") for t in targets if not re.match(r"[a-z]+:", t)]
    return [((page.parent / path).resolve() if path else page, at) for path, _, at in inside]


def find_anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a page."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.strip().lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_every_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    found = find_links(page)
    assert [path for path, _ in found if not path.exists()] == []
    assert [(p.name, at) for p, at in found if at and at not in find_anchors(p)] == []


def find_reachable_pages(start: Path) -> set[Path]:
    """Return the pages that can be reached from a page by links."""
    seen, todo = {start}, [start]
    while todo:
        new = {p for p, _ in find_links(todo.pop()) if p.suffix == ".md" and p.exists()} - seen
        seen |= new
        todo += new
    return seen


def test_no_page_is_orphaned() -> None:
    assert set(ROOT.glob("docs/*.md")) - find_reachable_pages(ROOT / "README.md") == set()


def test_the_index_names_every_page() -> None:
    index = ROOT / "docs/index.md"
    named = {path for path, _ in find_links(index)} | {index}
    assert sorted(p.name for p in set(ROOT.glob("docs/*.md")) - named) == []


@pytest.mark.parametrize(
    ("page", "link", "shown"),
    [
        ("index.md", "[catalogue.md](catalogue.md#queries)", "[Catalogue](catalogue.md#queries)"),
        ("index.md", "[SECURITY.md](../SECURITY.md)", "[Security](security.md)"),
        ("contributing.md", "[docs/faq.md](docs/faq.md)", "[Common errors](faq.md)"),
        ("index.md", "[the terms](concepts.md)", "[the terms](concepts.md)"),
        ("index.md", "[CHANGELOG.md](../CHANGELOG.md)", "CHANGELOG.md"),
    ],
)
def test_the_site_shows_titles_in_place_of_file_names(page: str, link: str, shown: str) -> None:
    convert = runpy.run_path(str(ROOT / "docs/site.py"))["on_page_markdown"]
    found = convert(
        f"See {link}\n```\n{link}\n```\n", SimpleNamespace(file=SimpleNamespace(src_uri=page))
    )
    assert found == f"See {shown}\n```\n{link}\n```\n"


def test_architecture_page_lists_the_checked_layers_and_packages() -> None:
    page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| `(\w+)` \| .* \|(.*)\|$", page, re.MULTILINE)
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    contracts = {c["id"]: c for c in tomllib.loads(text)["tool"]["importlinter"]["contracts"]}
    layers = [layer.split(" | ") for layer in contracts["down"]["layers"]]
    wanted = [(str(k), room) for k, layer in enumerate(layers, 1) for room in layer]
    assert [(number, room) for number, room, _ in rows] == wanted
    homes = {room: set(re.findall(r"\w+", said)) for _, room, said in rows if said.strip()}
    held: dict[str, set[str]] = {}
    for arrow in contracts["homes"]["ignore_imports"]:
        importer, package = arrow.split(" -> ")
        held.setdefault(importer.split(".")[1], set()).add(package.replace("rerun_cli", "rerun"))
    assert homes == held


@pytest.mark.heavy
def test_the_page_on_python_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = ROOT / "docs/python.md"
    monkeypatch.chdir(tmp_path)
    for line in find_command_lines(page):
        app(shlex.split(line)[1:], result_action="return_value")
    capsys.readouterr()
    code = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    exec("\n".join(code), {})
    output = capsys.readouterr().out
    assert "/cf1/labels dmrl.v1.PeerLabels 20\n" in output
    assert "16 (16, 28, 40)\n" in output
    assert "torch.Size([8, 3, 224, 320]) torch.Size([8, 28, 40])" in output


SKIPPED = re.compile(
    r"dmrl (view|render|dataset renders|train dataset (model$|few|refined)|train .*-renders)"
)
"""Commands that need a window or Blender, or take long; slow tests run the last three kinds."""


def find_blocks(page: Path, until: str | None) -> list[tuple[str, str]]:
    """Return language and text of the code blocks of a page, in order, up to a heading."""
    text = page.read_text(encoding="utf-8")
    text = text if until is None else text[: text.index(until)]
    return re.findall(r"```(sh|python|toml)\n(.*?)```", text, re.DOTALL)


def run_page(page: Path, until: str | None = None, skipped: re.Pattern[str] = SKIPPED) -> None:
    """Run the commands and programs of a page in the working folder, as they are written."""
    names: dict[str, object] = {}
    for kind, block in find_blocks(page, until):
        if kind == "python":
            exec(block, names)
            continue
        if kind == "toml":
            Path("map.toml").write_text(block, encoding="utf-8")
            continue
        for line in re.findall(r"^(dmrl .*)", block.replace("\\\n", " "), re.MULTILINE):
            if not skipped.match(line):
                app(shlex.split(line, comments=True)[1:], result_action="return_value")


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("name", "until", "said"),
    [
        ("own_network.md", None, "seen.mcap"),
        ("own_robot.md", None, "positions are OK"),
        ("own_camera.md", "## 4.", "focal_px"),
    ],
)
def test_commands_of_a_page_run_as_written(
    name: str,
    until: str | None,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    if name == "own_camera.md":  # the page lets the reader draw these pictures
        app(["sketch", "shots", "--images", "12"], result_action="return_value")
    run_page(ROOT / "docs" / name, until)
    assert said in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_own_camera_refinement_commands_run_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    app(["sketch", "shots", "--images", "40"], result_action="return_value")
    run_page(ROOT / "docs/own_camera.md", "## 4.", re.compile("dmrl view"))
    assert capsys.readouterr().out.count("last loss") == 4


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_readme_commands_run_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run_page(ROOT / "README.md", skipped=re.compile("dmrl view"))
    assert {"tracks.mcap", "out"} <= {path.name for path in tmp_path.iterdir()}
    assert "mismatches" in capsys.readouterr().out


@pytest.mark.slow
def test_mount_calibration_commands_run_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    flight = "fly fly_in_view mount.mcap --camera"
    page = (ROOT / "docs/own_camera.md").read_text(encoding="utf-8")
    assert f"`dmrl {flight}`" in page
    app(flight.split(), result_action="return_value")
    (block,) = re.findall(r"```sh\n(.*?)```", page[page.index("## 4.") :], re.DOTALL)
    for line in block.replace("refined", "dmrl-nano").splitlines():
        app(shlex.split(line)[1:], result_action="return_value")
    assert "median_after_px" in capsys.readouterr().out


def test_faq_quotes_existing_error_messages() -> None:
    page = (ROOT / "docs/faq.md").read_text(encoding="utf-8")
    quoted = [h for h in re.findall(r"^## (.*)", page, re.MULTILINE) if h[0].islower()]
    sources = "".join(p.read_text(encoding="utf-8") for p in ROOT.glob("dmrl/**/*.py"))
    sources += "".join(p.read_text(encoding="utf-8") for p in ROOT.glob("viewer/**/*.py"))
    joined = re.sub(r'"\s*f?"', "", sources)
    parts = {part.strip() for heading in quoted for part in heading.split("...") if part.strip()}
    assert len(quoted) >= 8
    assert [part for part in parts if part not in joined] == []


def test_the_two_set_up_commands_are_targets_of_make() -> None:
    wanted = set(
        re.findall(r"\bmake ([a-z-]+)", " ".join(_find_code(page) for page in HAND_WRITTEN))
    )
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {"demo", "test"} <= wanted <= targets


def _find_code(page: Path) -> str:
    """Return the shell blocks and the inline code of a page, joined by spaces."""
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"```sh\n(.*?)```|`([^`\n]+)`", text, re.DOTALL)
    return " ".join(block or quoted for block, quoted in found)


def test_make_demo_installs_the_documented_packages() -> None:
    makefile = (ROOT / "Makefile").read_text()
    (installed,) = re.findall(r"^\$\(VENV\)/\.demo:.*\n\t.*'\.\[(.*)\]'", makefile, re.MULTILINE)
    typed = {line.split()[1] for line in find_command_lines(ROOT / "docs/first_evening.md")}
    needed = {e for e, words in EXTRAS.items() if typed & set(re.findall(r"[a-z]+", words))}
    optional = {"table", "deploy", "coco"}  # for --to csv, ONNX beside PyTorch, and boxes
    assert {"label", "view"} <= needed <= set(installed.split(",")) | optional


def test_documented_bad_share_equals_the_default() -> None:
    page = (ROOT / "docs/labelling.md").read_text(encoding="utf-8")
    share = f"{BAD_SHARE:.0%}".replace("%", " %")
    assert f"at most {share} are expected to be bad" in re.sub(r"\s+", " ", page)
    assert "--bad-share" in (ROOT / "docs/commands.md").read_text(encoding="utf-8")
