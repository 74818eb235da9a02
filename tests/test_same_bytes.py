"""The same seed gives the same bytes on any machine and with any settings."""

import hashlib
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.heavy
COMMANDS = {
    "sketch": "sketch out --images 20",
    "pilot": "fly fly_in_view out.mcap --pilot follow --eye truth --duration-s 6 --seed 2",
    "fly": "fly fly_in_view out.mcap --duration-s 8 --seed 2 --camera --camera-rate-hz 1",
    "label": "label {flight} out.mcap",
    "dataset": "dataset {flight} out --split none",
    "convert": "convert {flight} out --to csv",
}
MACHINES = {
    "one thread": {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "TZ": "UTC"},
    "two threads, C locale": {
        "OPENBLAS_NUM_THREADS": "2",
        "OMP_NUM_THREADS": "2",
        "LC_ALL": "C",
        "PYTHONUTF8": "0",
        "TZ": "America/St_Johns",
    },
    "eight threads, umask 077": {
        "OPENBLAS_NUM_THREADS": "8",
        "OMP_NUM_THREADS": "8",
        "LC_ALL": "de_DE.UTF-8",
        "TZ": "Asia/Kathmandu",
        "PYTHONHASHSEED": "7",
        "UMASK": "077",
    },
}
if platform.machine() == "x86_64":
    MACHINES["an older processor"] = {
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4",
        "OPENBLAS_CORETYPE": "Nehalem",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
    }


def run(words: str, folder: Path, **settings: str) -> str:
    """Run a command in a folder; return the hash of its files, without SVG figures."""
    umask = int(settings.pop("UMASK", "022"), 8)
    subprocess.run(
        [sys.executable, "-m", "dmrl.cli", *words.split()],
        cwd=folder,
        env=os.environ | settings,
        check=True,
        capture_output=True,
        umask=umask,
    )
    total = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix != ".svg"):
        total.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return total.hexdigest()


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fly 12 s with the default number of threads; return the recording."""
    folder = tmp_path_factory.mktemp("flight")
    run("fly fly_in_view flight.mcap --duration-s 12 --camera --camera-rate-hz 1", folder)
    return folder / "flight.mcap"


@pytest.mark.parametrize("command", COMMANDS)
def test_same_seed_gives_same_bytes_on_any_machine(
    command: str, flight: Path, tmp_path: Path
) -> None:
    hashes = {}
    for number, (name, settings) in enumerate(MACHINES.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        hashes[name] = run(COMMANDS[command].format(flight=flight), folder, **settings)
    first = hashes["one thread"]
    assert [name for name, value in hashes.items() if value != first] == []


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one core has one thread")
def test_stages_in_python_use_one_blas_thread(tmp_path: Path) -> None:
    """A stage limits BLAS to one thread even if NumPy was imported before with more."""
    code = """
import sys
import numpy
import dmrl
import dmrl.stages.sketch as stage
from threadpoolctl import threadpool_info

def count_threads():
    return [lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"]

stage._check = lambda settings: seen.extend(count_threads())
seen, before = [], count_threads()
dmrl.sketch(sys.argv[1], images=2)
print(set(before), set(seen), max(count_threads()))
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "out")],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "2"},
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stdout == "{2} {1} 2\n"
