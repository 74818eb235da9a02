"""The command line as a whole: help, exit status and one-line errors."""

import ast
import io
import itertools
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

from dmrl import __version__, atomic_output, cli
from dmrl.cli import COMMANDS, app
from dmrl.errors import DmrlError, StorageError, suggest
from dmrl.guards.safe_names import truncate_middle

HEAVY = {
    *("bpy", "datasets", "h5py", "matplotlib", "mcap", "numpy", "pandas", "PIL", "pyarrow"),
    *("pydantic", "rerun", "tensorboard", "torch"),
}
OPTIONAL = (
    *("torch", "safetensors", "tensorboard", "h5py", "rerun", "rerun_cli", "matplotlib", "pandas"),
    *("filterpy", "datasets", "foxglove_schemas_protobuf", "grpc_tools", "mcap_protobuf"),
    *("onnx", "onnxruntime", "duckdb"),
)
STAGES = Path(cli.__file__).parent / "stages"


def run_dmrl(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own."""
    command = [sys.executable, "-m", "dmrl.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], []])
@pytest.mark.heavy
def test_help_and_version_load_nothing_heavy(arguments: list[str]) -> None:
    code = (
        "import sys\n"
        "from dmrl.cli import app\n"
        f"try: app({arguments})\n"
        "except SystemExit as e: assert not e.code, e.code\n"
        f"print(sorted({HEAVY} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


@pytest.mark.heavy
def test_version_is_the_package_s() -> None:
    done = run_dmrl("--version")
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, __version__, "")


def test_help_lists_every_command_in_the_order_of_the_work(
    capsys: pytest.CaptureFixture[str],
) -> None:
    app.help_print([])
    lines = capsys.readouterr().out.splitlines()
    words = [line.split()[1] for line in lines if line.startswith("│ ") and line[2] != " "]
    assert words[: len(COMMANDS)] == list(COMMANDS)
    titles = [line.split()[1] for line in lines if line.startswith("╭─ ")]
    assert titles == [*(title.split()[0] for title in cli.GROUPS), "Others"]


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        *(("merge", "IN... OUT"), ("check", "IN..."), ("find", "QUERY [FOLDER]")),
        *(("report", "FOLDER [OUT]"), ("dataset", "IN... OUT"), ("trim", "RECORDING OUT")),
        ("fake-drone", ""),
    ],
)
def test_usage_names_every_argument_and_which_take_several(name: str, arguments: str) -> None:
    page = io.StringIO()
    cli.print_help(name, Console(file=page, width=88))
    usage = page.getvalue().splitlines()[0]
    assert usage.startswith(f"Usage: dmrl {name} ")
    assert usage.partition("[OPTIONS]")[2].strip() == arguments


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.heavy
def test_help_lines_are_filled_before_wrapping(name: str) -> None:
    page = io.StringIO()
    cli.print_help(name, Console(file=page, width=88))
    rows = [line[2:-2] for line in page.getvalue().splitlines() if line.startswith("│ ")]
    for row, after in itertools.pairwise(rows):
        went_on = after[:4].strip() == "" and len(after) - len(after.lstrip()) >= 4
        same = len(row) - len(after) == 0 and went_on
        room = len(row) - len(row.rstrip())
        assert not same or room <= len(after.split()[0]), (row, after)


def test_every_stage_is_in_the_table() -> None:
    with_command = {
        path.stem.replace("_", "-")
        for path in STAGES.glob("*.py")
        if re.search(r"^(def command\(|command = )", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert with_command == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_argument_and_flag_of_a_command_is_explained(name: str) -> None:
    arguments = app[name].assemble_argument_collection(parse_docstring=True)
    shown = [a for a in arguments.filter_by(show=True) if a.parse]
    assert not [a.name for a in shown if not (a.parameter.help or "").strip()]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_fits_a_narrow_terminal(name: str) -> None:
    page = io.StringIO()
    app.help_print([name], console=Console(file=page, width=50))
    assert page.getvalue().startswith(f"Usage: dmrl {name}")
    assert max(map(len, page.getvalue().splitlines())) <= 50


HELP_OF_EACH = """
import contextlib, io, json, sys, time
from dmrl.cli import COMMANDS, main
said = {}
for name in COMMANDS:
    sys.argv, out, err = ["dmrl", name, "--help"], io.StringIO(), io.StringIO()
    begun_s = time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try: main()
        except SystemExit as e: status = e.code
    spent_s = time.process_time() - begun_s
    packages = {m.partition(".")[0] for m in sys.modules} - sys.stdlib_module_names
    said[name] = status, out.getvalue(), err.getvalue(), sorted(packages), spent_s
print(json.dumps(said))
"""
Result = tuple[int, str, str, list[str], float]
"""Exit status, standard output and error of a command's help, loaded packages, CPU seconds."""


@pytest.fixture(scope="module")
def results() -> dict[str, Result]:
    """Return the help of every command as `main` prints it, all in one process."""
    script = [sys.executable, "-c", HELP_OF_EACH]
    done = subprocess.run(script, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout))


@pytest.fixture(scope="module")
def results_without_extras() -> dict[str, Result]:
    """Return the help of every command as printed where no extra is installed."""
    hide = f"import sys\nsys.modules.update(dict.fromkeys({OPTIONAL}))\n"
    script = [sys.executable, "-c", hide + HELP_OF_EACH]
    done = subprocess.run(script, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout))


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.heavy
def test_help_loads_no_package_that_only_the_command_needs(
    name: str, results: dict[str, Result]
) -> None:
    mine = {package for package in results[name][3] if not package.startswith("_")}
    assert mine <= {
        "dmrl",
        "cyclopts",
        "rich",
        "attr",
        "attrs",
        "docstring_parser",
        "sphinxcontrib",
        "typing_extensions",
    }


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.heavy
def test_help_of_a_command_is_quick(name: str, results: dict[str, Result]) -> None:
    """The first command also pays for the import of the command line: all share a process."""
    assert results[name][4] < 0.35


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.heavy
def test_help_needs_no_extra(
    name: str,
    results: dict[str, Result],
    results_without_extras: dict[str, Result],
) -> None:
    status, output, errors, *_ = results[name]
    assert results_without_extras[name][:3] == [status, output, errors]
    assert status in (0, None) and output.startswith(f"Usage: dmrl {name}")


@pytest.mark.heavy
@pytest.mark.parametrize(("name", "words"), [("train", ["dataset", "out"]), ("view", ["a.mcap"])])
def test_without_the_extras_a_command_names_the_extra(
    name: str, words: list[str], tmp_path: Path
) -> None:
    hide = f"import sys\nsys.modules.update(dict.fromkeys({OPTIONAL}))\n"
    code = f"{hide}sys.argv = {['dmrl', name, *words]}\nfrom dmrl.cli import main\nmain()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert (done.returncode, done.stdout) == (1, ""), done.stderr
    assert "Install it with: pip install 'dmrl[" in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr


def test_a_short_command_with_a_letter_too_many_is_suggested() -> None:
    assert suggest("f" + "lie", COMMANDS, "") == "Did you mean fly?"
    assert suggest("qqqq", COMMANDS, "Try: dmrl --help") == "Try: dmrl --help"


@pytest.mark.heavy
def test_unknown_command_suggests_the_nearest_with_or_without_extras() -> None:
    hide = f"import sys\nsys.modules.update(dict.fromkeys({OPTIONAL}))\n"
    code = "sys.argv = ['dmrl', 'trian']\nfrom dmrl.cli import main\nmain()"
    for script in (f"import sys\n{code}", hide + code):
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stdout) == (2, ""), done.stderr
        assert done.stderr == "dmrl: no command trian. Did you mean train?\n"


@pytest.mark.heavy
@pytest.mark.parametrize(
    "arguments",
    [["info"], ["info", "a.mcap", "--colour"], ["fly", "fly_in_view", "a.mcap", "--seed", "1.5"]],
)
def test_usage_error_is_on_stderr_with_status_2(arguments: list[str]) -> None:
    done = run_dmrl(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("dmrl: ")
    assert "Traceback" not in done.stderr


@pytest.mark.heavy
def test_a_known_error_is_one_line_on_stderr_with_status_1(tmp_path: Path) -> None:
    done = run_dmrl("info", str(tmp_path / "absent.mcap"))
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("dmrl: ")
    assert "absent.mcap" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.heavy
def test_flag_without_robot_name_shows_the_right_form(tmp_path: Path) -> None:
    done = run_dmrl(
        "label", str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap"), "--camera", "my.toml"
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "dmrl: --camera my.toml does not say of what. Try: --camera.cf1 my.toml\n"
    )


def test_overlong_error_keeps_its_file_and_remedy() -> None:
    line = f"flight.mcap has {'far ' * 500}too much. Try: dmrl trim"
    short = truncate_middle(line)
    assert len(short) < 500
    assert short.startswith("flight.mcap has") and short.endswith("Try: dmrl trim")
    assert truncate_middle("short") == "short"


def _raise_in_main(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> object:
    """Let a command of a plug-in raise an error; return the exit status of `main`."""

    def fail() -> None:
        raise error

    monkeypatch.setattr(cli, "app", fail)
    monkeypatch.setattr(sys, "argv", ["dmrl", "command-of-a-plugin"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return end.value.code


def test_ctrl_c_ends_with_one_line_and_status_130(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(atomic_output, "_started_outputs", [])
    assert _raise_in_main(KeyboardInterrupt(), monkeypatch) == 130
    assert capsys.readouterr().err.count("\n") == 1


def test_ctrl_c_ends_a_command_that_waits_for_storage(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> list[Path]:
        raise StorageError("s3://lab/out: nobody answers")

    monkeypatch.setattr(atomic_output, "list_finished_outputs", fail)
    assert _raise_in_main(KeyboardInterrupt(), monkeypatch) == 130
    said = "dmrl: stopped. What has its final name is not known: s3://lab/out: nobody answers\n"
    assert capsys.readouterr().err == said


def _iter_subclasses(error: type[Exception]) -> Iterator[type[Exception]]:
    """Yield the subclasses of a class and theirs."""
    for child in error.__subclasses__():
        yield child
        yield from _iter_subclasses(child)


def test_documented_error_tree_equals_the_classes() -> None:
    tree = sys.modules[DmrlError.__module__].__doc__ or ""
    drawn = [
        line.split()[1] for line in tree.splitlines() if line.lstrip()[:2] in ("* ", "- ", "+ ")
    ]
    own = [e.__name__ for e in _iter_subclasses(DmrlError) if e.__module__ == DmrlError.__module__]
    assert sorted(drawn) == sorted(["DmrlError", *own])


def _find_message_prints(path: Path) -> Iterator[int]:
    """Yield the lines of a module that call ``print(..., file=...)``."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        match node:
            case ast.Call(func=ast.Name("print"), keywords=words) if "file" in {
                word.arg for word in words
            }:
                yield node.lineno


@pytest.mark.parametrize("path", sorted(STAGES.glob("*.py")), ids=lambda p: p.stem)
def test_stages_print_data_only_and_leave_messages_to_progress(path: Path) -> None:
    assert list(_find_message_prints(path)) == []


@pytest.mark.heavy
def test_the_shell_completes_commands_flags_and_choices(tmp_path: Path) -> None:
    script = tmp_path / "dmrl.bash"
    command = [sys.executable, "-m", "dmrl.cli", "--install-completion", "--shell", "bash"]
    home = {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run([*command, "--output", str(script)], env=home, capture_output=True)
    assert done.returncode == 0, done.stderr
    ask = """source $1; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
        $(complete -p dmrl | sed 's/.*-F \\([^ ]*\\).*/\\1/')
        echo "${COMPREPLY[@]}" """

    def complete(*words: str) -> list[str]:
        line = ["bash", "-c", ask, "bash", str(script), *words]
        return subprocess.run(line, capture_output=True, text=True).stdout.split()

    assert complete("dmrl", "pre") == ["predict"]
    assert complete("dmrl", "predict", "--back") == ["--backend"]
    assert {"onnx", "integer", "c"} <= set(complete("dmrl", "predict", "--backend", ""))
