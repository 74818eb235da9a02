"""The command line: a table of commands, each loaded when it is called.

A command's flags and help come from the function that the table names; errors a user can
act on become one line and exit status 1.
"""

import gc
import sys
from collections.abc import Sequence
from difflib import get_close_matches
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
    convert,
)
from rich.console import Console
from rich.text import Text

from dmrl import __version__, boundary, entry_points
from dmrl.guards.numeric_threads import set_one_blas_thread
from dmrl.guards.safe_names import truncate_middle
from dmrl.guards.temporary_folder import use_own_temporary_folder
from dmrl.storage import to_path
from dmrl.terminal import help_pages
from dmrl.terminal.signals import end_on_signal

# In the order of the work. The help line is the first line of the function's docstring;
# it stands here too so that `dmrl --help` loads nothing (a test holds the two together).
COMMANDS = {
    "demo": "Run the whole pipeline, small, on a flight that ships and on pictures it draws.",
    "run": "Run the steps of a pipeline recipe whose outputs are not up to date, side by side.",
    "doctor": "List packages, programs and devices that dmrl uses, and how to get missing ones.",
    "record": "Record logs and images of flying Crazyflies, until Ctrl-C.",
    "convert": "Convert a foreign file or folder into a recording, or a recording into files.",
    "fly": "Simulate a flight of robots that measure themselves and each other.",
    "render": "Render images of robots with exact labels, as a recipe says, into a recording.",
    "sketch": "Draw a folder of pictures of small drones, with exact labels.",
    "likeness": "Fit a render recipe to your own frames, and show both side by side.",
    "fake-drone": "Send a simulated flight as Crazyflies and AI-decks do, to try record with.",
    "calibrate": "Calibrate cameras by boards or flights, and other sensors by several flights.",
    "align": "Synchronise clocks by ranges of pairs, by images, or by motion capture.",
    "label": "Find every robot's peers from ranges and odometry, and label the images with them.",
    "dataset": "Build an Arrow dataset and its card from recordings.",
    "train": "Train a network on a dataset.",
    "predict": "Run a network on every image of a recording.",
    "track": "Follow detected peers over time: 3D tracks with covariance.",
    "evaluate": "Evaluate detections against labels; tracks and positions against the truth.",
    "score": "Score a submission to the benchmark over the sealed seeds.",
    "quantize": "Quantise a network to int8, and measure the loss of accuracy.",
    "export": "Write a network as ONNX and as C.",
    "verify": "Prove that the C of an export computes the int8 network, bit for bit.",
    "view": "Show recordings in rerun, or save them as an .rrd file or a picture.",
    "report": "Show the results in a folder as one HTML page that needs nothing else.",
    "info": "Show the contents and the origin of a recording.",
    "check": "Check a recording: schemas, times, gaps, calibration, labels.",
    "index": "List the recordings of a folder in catalogue.parquet, for dmrl find.",
    "find": "Find recordings by their contents: the table of dmrl index, queried in SQL.",
    "recover": "Recover the messages of a damaged or unfinished recording.",
    "merge": "Merge recordings into one, by time.",
    "trim": "Cut a time range out of a recording, or keep some of its topics.",
    "card": "Write a dataset's card and figures again; text below its last line is kept.",
}
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
"""Commands by what they are for. One that is in no group is listed last."""
COMPLETION = "--install-completion"


def format_usage_error(error: CycloptsError) -> Text:
    """Return the line to print for a command line that cannot be parsed."""
    if isinstance(error, CoercionError) and get_origin(error.target_type) is dict and error.token:
        flag, value = error.token.keyword, error.token.value
        return Text(f"dmrl: {flag} {value} does not say of what. Try: {flag}.cf1 {value}")
    if not isinstance(error, UnknownCommandError) or not error.unused_tokens:
        return Text(f"dmrl: {truncate_middle(str(error))}")
    # The error's own text would load every command, and fail where an extra is missing.
    word = error.unused_tokens[0]
    near = get_close_matches(
        word, [*COMMANDS, *entry_points.find_plugins(entry_points.STAGES)], n=1
    )
    hint = f"Did you mean {near[0]}?" if near else "Try: dmrl --help"
    return Text(f"dmrl: no command {word}. {hint}")


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
_groups: dict[str, Group] = {}
for _place, (_title, _names) in enumerate(GROUPS.items()):
    _groups |= dict.fromkeys(_names, Group(_title, sort_key=_place))
for _order, (_name, _help) in enumerate(COMMANDS.items()):
    _run = f"dmrl.stages.{_name.replace('-', '_')}:command"
    app.command(_run, name=_name, help=_help, group=_groups.get(_name), sort_key=_order)


def add_plugin_commands() -> App:
    """Add the commands of other packages to the command line.

    `main` does so only if dmrl has no such command: it takes 50 ms, a third of the start.
    """
    for name, plugin in entry_points.find_plugins(entry_points.STAGES).items():
        if name not in COMMANDS and name not in app:
            words = f"{plugin.summary} (of the package {plugin.package})".strip()
            app.command(f"dmrl.entry_points:{name}", name=name, help=words, sort_key=len(COMMANDS))
    return app


def main() -> NoReturn:
    """Run the command; turn errors into one line and an exit status."""
    boundary.open_standard_streams()
    boundary.install_signal_handlers()
    set_one_blas_thread()
    use_own_temporary_folder()
    name, *words = sys.argv[1:] or [""]
    if name not in COMMANDS:
        add_plugin_commands()
    wants_help = name in COMMANDS and not set(app.help_flags).isdisjoint(words)
    status = boundary.run_to_status((lambda: print_help(name)) if wants_help else app)
    end_on_signal(boundary.describe_interrupt)  # what libraries do at exit loses an exception
    raise SystemExit(status)


def print_help(name: str, console: Console | None = None) -> None:
    """Print a command's help and its examples; load nothing that only its work needs."""
    gc.disable()  # it prints a page and ends: a collection would only cost time
    app.help_print([name], console=console)
    help_pages.print_examples(name, console or Console())


if __name__ == "__main__":
    main()
