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
from dmrl.estimation.evidence.error_models import MODELS, ErrorModel
from dmrl.estimation.solver.robust_loss import Cauchy
from dmrl.estimation.solver.unknowns import Unknown
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


def error_models() -> str:
    """Format the table of error models, from dmrl/estimation/evidence/error_models.py."""
    rows = [
        (model.name, "; ".join(_describe_changes(model)), f"{model.log_odds:.3g}")
        for model in MODELS
    ]
    return table(("cause", "unknowns, or factor of a noise", "log odds"), rows)


def _describe_changes(model: ErrorModel) -> list[str]:
    factors = (("range noise", model.range_factor), ("velocity noise", model.flow_factor))
    if model.for_a_while:
        return ["2 to 16 times the velocity noise in stretches"]
    return [
        *(_describe_unknown(row) for row in model.rows),
        *(f"{factor:g} times the {noise}" for noise, factor in factors if factor != 1.0),
    ]


def _describe_unknown(row: Unknown) -> str:
    unit = "" if row.unit == "1" else f" {row.unit}"
    loss = f", Cauchy {row.loss.sigmas:g}" if isinstance(row.loss, Cauchy) else ""
    match row.evolution:
        case "constant":
            kind = f"{row.std:g}{unit}"
        case "fading":
            kind = f"{row.std:g}{unit}, fading in {row.time_s:g} s"
        case _:
            kind = f"{row.start_std:g}{unit} at first, steps of {row.std:g}{unit}/sqrt(s)"
    return f"`{row.name}` {kind}{loss}"


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
    parts = {"topics": topics(), "extras": extras(), "error models": error_models()}
    for name, body in parts.items():
        text = re.sub(
            rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)",
            lambda found, body=body: f"{found[1]}{body}\n{found[2]}",
            text,
            flags=re.DOTALL,
        )
    return text


def pages() -> dict[Path, str]:
    """Every page that is generated, or in part, with its text."""
    names = ("index", "formats", "labelling")
    made = {page: filled(page) for page in (ROOT / f"docs/{name}.md" for name in names)}
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
