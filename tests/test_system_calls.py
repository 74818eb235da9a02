"""Commands open no network socket, write only to OUT, and leave no temporary file.

Each command runs under strace. SECURITY.md lists the few other paths that a command may write, and
the commands that need sockets: `record`, `fake-drone`, `view --serve` and `--on ray`.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dmrl.cli import COMMANDS
from dmrl.rendering.blender_environment import environment_folder

from .faults.inputs import Inputs
from .test_telemetry import make_user_environment

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not shutil.which("strace"), reason="strace is not installed (apt-get)"),
]
ROWS = {
    "doctor": "doctor",
    "sketch": "sketch {out}/a --images 2",
    "convert": "convert {pictures} {out}/a.mcap",
    "convert to csv": "convert {moment} {out}/a --to csv",
    "convert to ros2": "convert {dots} {out}/a --to ros2",
    "fly": "fly fly_in_view {out}/a.mcap --duration-s 2",
    "render": "render {scene} {out}/a.mcap",
    "likeness": "likeness {dots} {out}/a.toml",
    "calibrate": "calibrate {boards} {out}/a.toml --board 7x5",
    "align": "align {pair} {out}/a.mcap",
    "label": "label {flight} {out}/a.mcap",
    "dataset": "dataset {dots} {out}/a",
    "train": "train {set} {out}/a --recipe {short} --device cpu",
    "predict": "predict {model} {dots} {out}/a.mcap --backend onnx",
    "predict with torch": "predict {model} {dots} {out}/a.mcap --backend torch",
    "predict with C": "predict {int8} {dots} {out}/a.mcap --backend c",
    "track": "track {seen} {out}/a.mcap",
    "evaluate": "evaluate {found} --plots {out}/a",
    "quantize": "quantize {model} {set} {out}/a",
    "export": "export {int8} {out}/a",
    "verify": "verify {c} --images 1 --noise 1 --targets gcc",
    "view": "view {dots} --save {out}/a.rrd",
    "report": "report {flights} {out}/a.html",
    "info": "info {dots}",
    "check": "check {flight}",
    "index": "index {out}/flights",
    "find": "find true {indexed}",
    "recover": "recover {cut} {out}/a.mcap",
    "merge": "merge {dots} {seen} {out}/a.mcap",
    "trim": "trim {dots} {out}/a.mcap --to-s 0.9",
    "trim of a folder": "trim {flights} {out}/a --to-s 0.9 --workers 2",
    "card": "card {out}/set --title Another",
    "run": "run {chain} --out {out}/a",
}
ELSEWHERE = {
    "demo": "runs the commands above in turn",
    "record": "listens to robots: tests/faults/test_processes.py",
    "fake-drone": "sends to them: tests/faults/test_processes.py",
    "score": "reads what `dmrl run benchmark` wrote",
}
CALLS = "socket,openat,open,creat,mkdir,mkdirat,rename,renameat,renameat2,link,linkat,symlink"
CALL = re.compile(r'(\w+)\((?:\w+<([^>]*)>, )?"([^"]*)"(.*)')
ALLOWED_HOME = (".cache/matplotlib", ".config/matplotlib", ".cache/fontconfig")
OWN_CACHE = {"predict": ".cache/dmrl/onnx", "render": ".cache/dmrl"}
DEVICES = ("/dev/", "/proc/")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """Return the input files of the commands, each made on first use."""
    return Inputs(tmp_path_factory.mktemp("inputs"))


def fill_in_paths(words: str, inputs: Inputs, out: Path) -> list[str]:
    """Return the words of a command line with the paths of its inputs and its output."""
    names = re.findall(r"{(\w+)}", words)
    places = {name: out if name == "out" else getattr(inputs, name) for name in names}
    return [word.format(**places) for word in words.split()]


def find_written_path(line: str, cwd: Path) -> Path | None:
    """Return the path that a traced call writes, creates or renames; None for other calls."""
    found = CALL.search(line)
    if not found or " = -1 " in line:
        return None
    call, folder, name, flags = found.groups()
    if call in ("openat", "open") and not re.search("O_WRONLY|O_RDWR|O_CREAT", flags):
        return None
    return Path(folder or cwd, name)


def test_every_command_is_traced() -> None:
    assert {row.split()[0] for row in ROWS} | set(ELSEWHERE) == set(COMMANDS)


@pytest.mark.parametrize("row", ROWS)
def test_a_command_opens_no_socket_and_writes_nowhere_else(
    row: str, inputs: Inputs, tmp_path: Path
) -> None:
    if row == "render" and not environment_folder().exists():
        pytest.skip("Blender is not set up: dmrl render --setup")
    out, home, temporary = (tmp_path / name for name in ("out", "home", "tmp"))
    for folder in (out, home, temporary):
        folder.mkdir()
    if row == "index":
        shutil.copytree(inputs.flights, out / "flights")
    if row == "card":
        shutil.copytree(inputs.set, out / "set")
    words, trace = fill_in_paths(ROWS[row], inputs, out), tmp_path / "trace"
    environment = make_user_environment(home) | {
        "TMPDIR": str(temporary),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_NUM_THREADS": "1",
    }
    for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        environment.pop(name)
    if row == "render":
        (home / ".cache/dmrl").mkdir(parents=True)
        (home / ".cache/dmrl" / environment_folder().name).symlink_to(environment_folder())
    strace = ["strace", "-f", "-y", "-qq", "-s", "4096", "-e", f"trace={CALLS}", "-o", str(trace)]
    done = subprocess.run(
        [*strace, sys.executable, "-m", "dmrl", *words],
        cwd=out,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = trace.read_text(errors="replace").splitlines()
    assert len(lines) > 100
    sockets = [line for line in lines if re.search(r"socket\(AF_INET6?,", line)]
    assert sockets == []
    own = [OWN_CACHE[row]] if row in OWN_CACHE else []
    allowed = (out, temporary, *(home / name for name in (*ALLOWED_HOME, *own)))
    paths = {path for line in lines if (path := find_written_path(line, out))}
    elsewhere = [
        path
        for path in paths
        if not str(path).startswith(DEVICES)
        and not any(Path(os.path.normpath(path)).is_relative_to(place) for place in allowed)
        and path not in (home / ".cache", home / ".cache/dmrl", home / ".config")
    ]
    assert elsewhere == []
    assert list(temporary.iterdir()) == []
