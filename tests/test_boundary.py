"""Errors and signals end a command with one line on standard error and an exit status."""

import errno
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dmrl import __version__, boundary, cli
from dmrl.cli import COMMANDS, app
from dmrl.errors import OutputError

DMRL = [sys.executable, "-m", "dmrl.cli"]
PATIENCE_S = 120.0
"""Time limit for a process to start or to end, with a margin for a busy machine."""


def _raise_in_command(error: BaseException) -> int:
    """Return the exit status of a command that raises an error."""

    def fail() -> None:
        raise error

    return boundary.run_to_status(fail)


def test_internal_error_gives_one_line_with_the_traceback_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.delenv("DMRL_DEBUG", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert _raise_in_command(KeyError("a\nb")) == 1
    output = capsys.readouterr().err
    assert output.count("\n") == 1
    assert output.startswith("dmrl: internal error, KeyError: ")
    found = re.search(r"in (\S+)$", output)
    assert found is not None
    text = Path(found[1]).read_text()
    assert "Traceback (most recent call last)" in text
    assert "in fail" in text


def test_internal_error_keeps_its_traceback_in_debug_mode(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("DMRL_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        _raise_in_command(ZeroDivisionError())


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.EROFS, os.strerror(errno.EROFS), "a.mcap"), "a.mcap: Read-only file system"),
        (OSError(errno.EIO, os.strerror(errno.EIO)), "Input/output error"),
        (MemoryError(), "not enough memory"),
        (OutputError("a\x1b[31m\nb exists"), r"a\x1b[31m b exists"),
    ],
)
def test_os_error_gives_one_line_error(
    error: Exception,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("DMRL_DEBUG", raising=False)
    assert _raise_in_command(error) == 1
    output = capsys.readouterr().err
    assert words in output
    assert output.count("\n") == 1


def test_link_to_itself_gives_one_line_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (link := tmp_path / "a.mcap").symlink_to("a.mcap")
    words = ["merge", str(link), str(link), str(tmp_path / "b.mcap")]
    assert boundary.run_to_status(lambda: app(words)) == 1
    assert re.fullmatch(r"dmrl: .*a\.mcap.*\n", capsys.readouterr().err)


@pytest.mark.heavy
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_reports_that_no_output_is_complete(number: signal.Signals, tmp_path: Path) -> None:
    command = [*DMRL, "sketch", str(tmp_path / "out"), "--images", "99999"]
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        # A shell makes its background jobs ignore SIGINT, and their children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        try:
            until = time.monotonic() + PATIENCE_S
            while not (tmp_path / "out.partial" / "000001.png").exists():
                assert time.monotonic() < until
                time.sleep(0.05)
            process.send_signal(number)
            _, output = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == 128 + number
    assert output == "dmrl: stopped. No new output has its final name; earlier ones are unchanged\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.heavy
def test_signal_reports_complete_outputs(tmp_path: Path) -> None:
    code = (
        "import os, sys, signal; from pathlib import Path\n"
        "from dmrl import boundary; from dmrl.atomic_output import atomic_file\n"
        "def work():\n"
        "    for name in 'ab':\n"
        "        with atomic_file(Path(name)) as partial:\n"
        "            partial.write_text('x')\n"
        "            if name == 'b': os.kill(os.getpid(), signal.SIGTERM)\n"
        "boundary.install_signal_handlers(); sys.exit(boundary.run_to_status(work))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 143
    assert done.stderr == "dmrl: stopped. Whole: a; no other new output has its name\n"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize(
    ("where", "words"),
    [(">&-", "Bad file descriptor"), (">/dev/full", "No space left on device")],
)
@pytest.mark.heavy
def test_unwritable_stdout_gives_one_line_error(where: str, words: str) -> None:
    shell = f'"$@" {where}'
    command = ["sh", "-c", shell, "sh", *DMRL, "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("dmrl: ")
    assert words in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.heavy
def test_no_file_is_opened_as_a_closed_standard_stream(tmp_path: Path) -> None:
    code = (
        "from pathlib import Path; import os\n"
        "from dmrl import boundary\n"
        "boundary.open_standard_streams()\n"
        f"held = os.open({str(tmp_path / 'out')!r}, os.O_CREAT | os.O_WRONLY)\n"
        "raise SystemExit(held)\n"
    )
    command = ["sh", "-c", '"$@" <&- >&- 2>&-', "sh", sys.executable, "-c", code]
    assert subprocess.run(command, check=False).returncode > 2


@pytest.mark.heavy
def test_command_runs_without_home_temp_folder_or_locale(tmp_path: Path) -> None:
    out = tmp_path / "out"
    environment = {"PATH": os.environ["PATH"], "TMPDIR": "/nonexistent"}
    command = [*DMRL, "sketch", str(out), "--images", "2"]
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert out.is_dir()


@pytest.mark.parametrize("name", COMMANDS)
def test_removed_working_folder_is_reported_before_libraries_abort(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (gone := tmp_path / "gone").mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert boundary.run_to_status(lambda: app([name])) == 1
    assert capsys.readouterr().err == "dmrl: the folder you are in was removed. Go to another: cd\n"


EARLY = """
import sys
sys.argv = ["dmrl", *sys.argv[1:]]
from dmrl.__main__ import main

class Announcer:  # prints at the first import within main: no earlier code can handle a signal
    def find_spec(self, *_):
        sys.meta_path.remove(self)
        print("begun", flush=True)

sys.meta_path.insert(0, Announcer())
main()
"""


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("words", "longest_s"), [(["train", "dataset", "m"], 3.0), (["info", "a.mcap"], 0.3)]
)
def test_ctrl_c_gives_one_line_and_status_130(
    words: list[str], longest_s: float, tmp_path: Path
) -> None:
    """Each command is interrupted at 15 moments, during its imports and after them."""
    app(["sketch", str(tmp_path / "p"), "--images", "20"], result_action="return_value")
    for source, out in (("p", "a.mcap"), ("a.mcap", "dataset")):
        name = "dataset" if out == "dataset" else "convert"
        app([name, str(tmp_path / source), str(tmp_path / out)], result_action="return_value")
    ended = []
    for k in range(15):
        with subprocess.Popen(
            [sys.executable, "-c", EARLY, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        ) as process:
            assert process.stdout is not None and process.stdout.readline() == "begun\n"
            time.sleep(0.02 + longest_s * k / 15)
            process.send_signal(signal.SIGINT)
            _, output = process.communicate(timeout=PATIENCE_S)
        if process.returncode or words[0] == "train":  # info may have ended before the signal
            ended.append((process.returncode, output.replace("dmrl: loading torch\n", "")))
            ended[-1] = (ended[-1][0], ended[-1][1].replace("loading torch\n", ""))
    assert ended and {status for status, _ in ended} == {130}
    assert all(re.fullmatch(r"dmrl: stopped\. .*\n", output) for _, output in ended), ended


def test_ctrl_c_before_the_command_itself_gives_status_130(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt() -> None:
        raise boundary.Interrupted(signal.SIGINT)

    monkeypatch.setattr(cli, "use_own_temporary_folder", interrupt)
    monkeypatch.setattr(cli, "end_on_signal", lambda _: None)
    monkeypatch.setattr(boundary, "install_signal_handlers", lambda: None)
    with pytest.raises(SystemExit, match="130"):
        cli.main()
    assert capsys.readouterr().err.startswith("dmrl: stopped. ")


@pytest.mark.heavy
def test_python_dash_m_dmrl_is_the_command() -> None:
    line = [sys.executable, "-m", "dmrl", "--version"]
    assert subprocess.run(line, capture_output=True, text=True).stdout == f"{__version__}\n"
