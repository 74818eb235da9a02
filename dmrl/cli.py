"""The command line: a table of commands, each loaded when it is called.

A command's flags and help come from the function that the table names; errors a user can
act on become one line and exit status 1.
"""

import gc
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, get_args, get_origin

from cyclopts import (
    App,
    CoercionError,
    CycloptsError,
    Group,
    Parameter,
    Token,
    UnknownCommandError,
    UnusedCliTokensError,
    convert,
)
from rich.console import Console
from rich.text import Text

from dmrl import __version__, boundary, entry_points
from dmrl.errors import suggest
from dmrl.guards.numeric_threads import set_one_blas_thread
from dmrl.guards.safe_names import truncate_middle
from dmrl.guards.temporary_folder import use_own_temporary_folder
from dmrl.storage import to_path
from dmrl.terminal import help_pages
from dmrl.terminal.signals import end_on_signal

GROUPS = {
    "Start": ("demo", "run", "doctor"),
    "Make recordings": ("record", "convert", "fly", "render", "sketch", "likeness", "fake-drone"),
    "Label": ("calibrate", "align", "label"),
    "Learn": ("dataset", "train", "predict", "track", "evaluate", "score"),
    "Deploy": ("quantize", "export", "verify"),
    "Look": ("view", "report", "info", "check", "index", "find"),
    "Files": ("recover", "merge", "trim"),
    "Share": ("card",),
}
"""Commands by what they are for, in the order of the work."""
COMMANDS = tuple(name for names in GROUPS.values() for name in names)
COMPLETION = "--install-completion"


def format_usage_error(error: CycloptsError) -> Text:
    """Return the line to print for a command line that cannot be parsed."""
    if isinstance(error, CoercionError) and get_origin(error.target_type) is dict and error.token:
        flag, value = error.token.keyword, error.token.value
        return Text(f"dmrl: {flag} {value} does not say of what. Try: {flag}.cf1 {value}")
    if isinstance(error, UnusedCliTokensError) and error.unused_tokens:
        extra = truncate_middle(error.unused_tokens[0])
        chain = " ".join(("dmrl", *(error.command_chain or ())))
        return Text(f"dmrl: {extra} is one argument too many. Try: {chain} --help")
    if not isinstance(error, UnknownCommandError) or not error.unused_tokens:
        return Text(f"dmrl: {truncate_middle(str(error))}")
    # The error's own text would load every command, and fail where an extra is missing.
    word = error.unused_tokens[0]
    known = [*COMMANDS, *entry_points.find_plugins(entry_points.STAGES)]
    return Text(f"dmrl: no command {word}. {suggest(word, known, 'Try: dmrl --help')}")


def convert_strictly(kind: Any, tokens: Sequence[Token] | Sequence[str]) -> Any:
    """Convert words to a type. A path may be ``s3://bucket/key``.

    Raises
    ------
    ValueError
        If a whole number is required and one with a fraction is given: cyclopts would round it.
    DmrlError
        If a path is refused. Of ``Path | None`` cyclopts would say only that it is neither.
    """
    if type(None) in (members := get_args(kind)) and len(members) == 2:
        kind = next(member for member in members if member is not type(None))
    if Path in (kind, *get_args(kind)):
        return convert(kind, tokens, converter=lambda _, word: to_path(word))
    words = [token if isinstance(token, str) else token.value for token in tokens]
    whole = int in (kind, *get_args(kind)) and float not in get_args(kind)
    if whole and any("." in word for word in words):
        raise ValueError("a whole number is needed")
    return convert(kind, tokens)


app = App(
    name="dmrl",
    default_parameter=Parameter(converter=convert_strictly),
    help="Teach tiny camera drones to see each other: recordings in, recordings out.",
    version=__version__,
    help_format="plaintext",
    help_formatter=help_pages.Formatter(),
    group_commands=Group("Others", sort_key=len(GROUPS)),
    error_formatter=format_usage_error,
    error_console=Console(stderr=True, soft_wrap=True),  # one line, however narrow a pipe is
    suppress_keyboard_interrupt=False,  # main says what stands
)
app.register_install_completion_command(
    name=COMPLETION, help="Have the shell (bash, zsh, fish) complete commands, flags and choices."
)
for _place, (_title, _names) in enumerate(GROUPS.items()):
    _group = Group(_title, sort_key=_place)
    for _name in _names:  # its line of help is the first one of its docstring
        _run = f"dmrl.stages.{_name.replace('-', '_')}:command"
        app.command(_run, name=_name, group=_group, sort_key=COMMANDS.index(_name))


def add_plugin_commands(called: str = "") -> App:
    """Add the commands of other packages to the command line.

    Their help is the summary of their package, so that a list imports none; that of the command
    that is ``called`` is its docstring. `main` does so only if dmrl has no such command: it takes
    50 ms, a third of the start.
    """
    for name, plugin in entry_points.find_plugins(entry_points.STAGES).items():
        if name not in COMMANDS and name not in app:
            words = f"{plugin.summary} (of the package {plugin.package})".strip()
            shown = {} if name == called else {"help": words}
            app.command(f"dmrl.entry_points:{name}", name=name, sort_key=len(COMMANDS), **shown)
    return app


def main() -> NoReturn:
    """Run the command; turn errors into one line and an exit status."""
    boundary.open_standard_streams()
    boundary.install_signal_handlers()  # from here on a signal is an exception of _run_command
    status = boundary.run_to_status(_run_command)
    end_on_signal(boundary.describe_interrupt)  # what libraries do at exit loses an exception
    raise SystemExit(status)


def _run_command() -> None:
    set_one_blas_thread()
    use_own_temporary_folder()
    name, *words = sys.argv[1:] or [""]
    if name not in COMMANDS:
        add_plugin_commands(called=name)
    for one in COMMANDS if name in ("--help", "-h") or not sys.argv[1:] else ():
        app[one]  # is loaded for its line of help
    if name in COMMANDS and not set(app.help_flags).isdisjoint(words):
        print_help(name)
    else:
        app()


def print_help(name: str, console: Console | None = None) -> None:
    """Print a command's help and its examples; load nothing that only its work needs."""
    gc.disable()  # it prints a page and ends: a collection would only cost time
    app[name].usage = help_pages.format_usage(app, name)
    app.help_print([name], console=console)
    help_pages.print_examples(name, console or Console())


if __name__ == "__main__":
    main()
