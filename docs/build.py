"""Write the generated parts of docs/: ``make docs`` does.

Tables come from the code that they describe, and docs/commands.md from the commands' own
help. A test compares them with what this file would write.
"""

import io
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

from rich.console import Console

from dmrl.cli import COMMANDS, print_help
from dmrl.topics import TOPICS

ROOT = Path(__file__).parents[1]
HELP_COLUMNS = 88

COMMANDS_HEAD = """\
# Commands

What `dmrl COMMAND --help` says, in the order of the work. Written by `make docs`.

Results go to standard output (`--json` gives one document for programs), progress and news to
standard error. Exit status: 0 done, 1 an error in one line, 2 a bad command line; see
[reliability.md](reliability.md).
"""


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Format a Markdown table."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def topics() -> str:
    """Format the table of topics, from dmrl/topics.py."""
    rows = [
        (
            f"`{t.pattern.replace('{', '<').replace('}', '>')}`",
            f"`{t.message}`",
            f"`{t.frame}`" if "<" in t.frame else t.frame,
            t.units,
            t.rate,
            ", ".join(
                w if w in COMMANDS else f"({w}, not there yet)" for w in t.written_by.split(", ")
            ),
        )
        for t in TOPICS
    ]
    return table(("topic", "message", "frame", "units", "rate", "written by"), rows)


def extras() -> str:
    """Format the table of extras, from pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    listed = tomllib.loads(text)["project"]["optional-dependencies"]
    rows = [
        (
            f"`dmrl[{name}]`",
            ", ".join(re.split(r"[<>=]", package)[0] for package in packages),
            _remark(text, name),
        )
        for name, packages in listed.items()
    ]
    return table(("extra", "brings", "for"), rows)


def _remark(pyproject: str, extra: str) -> str:
    found = re.search(rf"^{extra} = .*?#\s*(.*)$", pyproject, re.MULTILINE)
    return found.group(1) if found else ""


def commands() -> str:
    """docs/commands.md: the help of every command, at a fixed width."""
    parts = [COMMANDS_HEAD]
    for name in COMMANDS:
        page = io.StringIO()
        console = Console(file=page, width=HELP_COLUMNS, color_system=None, force_terminal=False)
        print_help(name, console)
        lines = "\n".join(line.rstrip() for line in page.getvalue().strip().splitlines())
        parts.append(f"## dmrl {name}\n\n```text\n{lines}\n```\n")
    return "\n".join(parts)


def filled(page: Path) -> str:
    """Fill each part of a page between ``<!-- name -->`` and ``<!-- /name -->`` again."""
    text = page.read_text(encoding="utf-8")
    for name, body in (("topics", topics()), ("extras", extras())):
        text = re.sub(
            rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)",
            lambda found, body=body: f"{found[1]}{body}\n{found[2]}",
            text,
            flags=re.DOTALL,
        )
    return text


def pages() -> dict[Path, str]:
    """Every page that is generated, or in part, with its text."""
    made = {page: filled(page) for page in (ROOT / "docs/index.md", ROOT / "docs/formats.md")}
    typed = runpy.run_path(str(ROOT / "docs/settings_types.py"))["settings_types"]()
    types = ROOT / "dmrl/api/settings.pyi"
    return {**made, ROOT / "docs/commands.md": commands(), types: format_code(typed, types)}


def format_code(text: str, path: Path) -> str:
    """Format Python as ``make format`` wants it."""
    ruff = [Path(sys.executable).parent / "ruff", "format", "--stdin-filename", path, "-"]
    made = subprocess.run(ruff, input=text, text=True, capture_output=True, check=True, cwd=ROOT)
    return made.stdout


if __name__ == "__main__":
    for target, content in pages().items():
        target.write_text(content, encoding="utf-8")
