"""Every flag of every data command is given an invalid value.

The command must print one line that names the flag or its file, and write no output.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest

from dmrl import boundary, cli
from dmrl.stages import fly

pytestmark = pytest.mark.slow

WORDS = {
    "convert": ["flight.mcap", "out"],
    "align": ["flight.mcap", "out.mcap"],
    "label": ["flight.mcap", "out.mcap"],
    "dataset": ["flight.mcap", "out"],
    "calibrate": ["flight.mcap", "out.toml"],
    "track": ["flight.mcap", "out.mcap"],
    "evaluate": ["flight.mcap"],
    "trim": ["flight.mcap", "out.mcap"],
    "sketch": ["out"],
    "fly": ["fly_in_view", "out.mcap"],
    "render": ["synthetic_first_look", "out.mcap"],
    "record": ["out.mcap", "--robot", "cf1=udp://127.0.0.1:1"],
}
"""The other arguments of each command; only flight.mcap exists."""


def iter_wrong_values() -> Iterator[tuple[str, str, str]]:
    """Yield command, flag and a value that is invalid for the type of the flag."""
    for command in WORDS:
        for argument in cli.app[command].assemble_argument_collection():
            flag = next((name for name in argument.names if name.startswith("--")), None)
            kind = str(argument.hint)
            if flag is None or "bool" in kind or "dict" in kind:
                continue
            if "Literal" in kind:
                yield command, flag, "sideways"
            elif "float" in kind:
                yield from ((command, flag, value) for value in ("many", "nan", "inf"))
            elif "int" in kind:
                yield from ((command, flag, value) for value in ("many", "1.5"))


CONTRADICTIONS = [
    ("convert", "--width-px", ["--width-px", "320"]),
    ("convert", "--rate-hz", ["--rate-hz", "0"]),
    ("convert", "--names", ["--names", "cf2"]),
    ("convert", "--robot", ["--robot", "c f"]),
    ("convert", "nowhere.toml", ["--columns", "nowhere.toml"]),
    ("trim", "--from", ["--from-s", "3", "--to-s", "1"]),
    ("trim", "--to", ["--to-s", "1e300"]),
    ("calibrate", "--board", ["--board", "9"]),
    ("label", "--range-offset-m", ["--range-offset-m", "-1e9"]),
    ("label", "--camera", ["--camera", "camera.toml"]),
    ("dataset", "--license", ["--license", "foo-1"]),
    ("dataset", "masks", ["--masks"]),
    ("fly", "--robots", ["--robots", "1"]),
    ("fly", "--duration-s", ["--duration-s", "-1"]),
    ("fly", "--camera-rate-hz", ["--camera-rate-hz", "0"]),
    ("sketch", "--images", ["--images", "0"]),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a short flight."""
    made = tmp_path_factory.mktemp("flags")
    fly.run(made / "flight.mcap", fly.Settings(2, 4.0, camera=True, camera_rate_hz=2))
    return made


def _run_refused(
    folder: Path,
    command: str,
    flags: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> str:
    """Run a command that must fail without output; return its one-line error."""
    monkeypatch.chdir(folder)
    words = [command, *WORDS[command], *flags]
    try:
        status = boundary.run_to_status(lambda: cli.app(words))
    except SystemExit as end:
        status = int(end.code or 0)
    output = capsys.readouterr()
    assert status in (1, 2), output
    lines = output.err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("dmrl: ") and not output.out
    assert [path.name for path in folder.iterdir()] == ["flight.mcap"]
    return lines[0]


@pytest.mark.parametrize(("command", "flag", "value"), [*iter_wrong_values()])
def test_invalid_value_is_refused_with_the_name_of_its_flag(
    folder: Path,
    command: str,
    flag: str,
    value: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    output = _run_refused(folder, command, [flag, value], capsys, monkeypatch)
    assert flag.removesuffix("-s") in output or flag.strip("-").replace("-", "_") in output


@pytest.mark.parametrize(("command", "named", "flags"), CONTRADICTIONS)
def test_contradicting_flags_are_refused_by_name(
    folder: Path,
    command: str,
    named: str,
    flags: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert named in _run_refused(folder, command, flags, capsys, monkeypatch)
