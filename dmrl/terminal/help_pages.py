"""Help pages: paragraphs filled to the width of the terminal, and examples below them.

Docstrings are wrapped for their readers. Printed as they are, their lines would break twice.
"""

import re
import tomllib
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions
from rich.text import Text

if TYPE_CHECKING:
    from cyclopts import App
    from cyclopts.help import HelpPanel


def fill_paragraphs(text: str) -> str:
    """Return a text with one line for each paragraph, list item or indented line."""
    return re.sub(r"(?<=\S)[ ]*\n(?=[^\s*-])", " ", text)


def format_usage(app: "App", name: str) -> str:
    """Return the line of usage of a command, with the names of all arguments without a flag."""
    from cyclopts.help import format_usage as format_flags  # noqa: PLC0415 - help alone

    words = [str(format_flags(app, [name])).partition("[OPTIONS]")[0] + "[OPTIONS]"]
    for argument in app[name].assemble_argument_collection(parse_docstring=False):
        if argument.index is None or not argument.show:
            continue
        takes_several = argument.token_count()[1]
        label = argument.name.upper() + "..." * (takes_several and "..." not in argument.name)
        # A command with any number of arguments, *recordings, checks itself that there is one.
        words.append(label if argument.required or takes_several else f"[{label}]")
    return " ".join(words)


def read_examples(command: str) -> list[str]:
    """Return the command lines that are shown as examples of a command; none of a plug-in's."""
    text = files("dmrl.stages").joinpath("examples.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text).get(command, ()))


def print_examples(command: str, console: Console) -> None:
    """Print the examples of a command, if it has any."""
    if lines := read_examples(command):
        console.print("Examples:", *(f"  {line}" for line in lines), sep="\n", markup=False)


def format_help(console: Console, options: ConsoleOptions, panel: "HelpPanel") -> None:
    """Print a panel of a help page, as cyclopts asks for, with its paragraphs filled."""
    from cyclopts.help.formatters.default import DefaultFormatter  # noqa: PLC0415 - help alone

    for entry in panel.entries:
        _fill(entry.description)
    DefaultFormatter()(console, options, panel)


def _fill(shown: Any) -> None:
    text = getattr(shown, "primary_renderable", None)
    if isinstance(text, Text):
        shown.primary_renderable = Text(fill_paragraphs(text.plain))


class Formatter:
    """Formatter of help pages, as cyclopts wants one."""

    __call__ = staticmethod(format_help)

    @staticmethod
    def render_usage(console: Console, _: ConsoleOptions, usage: Any) -> None:
        """Print the line of usage."""
        console.print(Text("Usage: ", style="bold") + Text(str(usage).strip()))
        console.print()

    @staticmethod
    def render_description(console: Console, _: ConsoleOptions, description: Any) -> None:
        """Print the description of a command."""
        _fill(description)
        console.print(description)
