"""Work in several processes: order, errors, killed workers, and no leftover process."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dmrl.errors import RecordingError, SettingError
from dmrl.pipeline.parallel_map import parallel_map

pytestmark = pytest.mark.heavy  # a process takes half a second to start

WAIT_PROGRAM = """
import sys, time
from pathlib import Path
from test_parallel_map import wait_there
from dmrl.pipeline.parallel_map import parallel_map

if __name__ == "__main__":
    list(parallel_map(wait_there, [Path(sys.argv[1])] * 2, 2))
"""

SIGNAL_PROGRAM = """
import signal
from test_parallel_map import hears_ctrl_c
from dmrl.pipeline.parallel_map import parallel_map

if __name__ == "__main__":
    print(list(parallel_map(hears_ctrl_c, [0, 1], 2)), hears_ctrl_c(0))
"""


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let new processes import this module by its name."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2])


def twice(value: int) -> tuple[int, int, str]:
    """Return twice the value, the process ID, and the number of OpenMP threads."""
    return 2 * value, os.getpid(), os.environ.get("OMP_NUM_THREADS", "")


def refuse(value: int) -> int:
    if value == 1:
        raise RecordingError("one.mcap is damaged")
    return value


def die(value: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def return_50_mb(value: int) -> bytes:
    return bytes(50_000_000)


def wait_there(folder: Path) -> None:
    """Make a file named by the process ID, and wait."""
    (folder / str(os.getpid())).touch()
    time.sleep(60)


def hears_ctrl_c(_: int) -> bool:
    """Return whether this process receives SIGINT."""
    return signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_only_the_process_that_starts_others_hears_ctrl_c(tmp_path: Path) -> None:
    """A worker that is interrupted while it starts would print a traceback."""
    script = tmp_path / "hears.py"
    script.write_text(SIGNAL_PROGRAM)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    done = subprocess.run(
        [sys.executable, str(script)], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[False, False] True\n"


def test_results_come_in_order_from_other_processes_of_one_core_each() -> None:
    found = list(parallel_map(twice, range(5), 2))
    assert [one[0] for one in found] == [0, 2, 4, 6, 8]
    assert os.getpid() not in {one[1] for one in found}
    assert {one[2] for one in found} == {"1"}


def test_one_worker_or_one_item_runs_in_process() -> None:
    for items, workers in ((range(3), 1), (range(1), 4)):
        assert {one[1] for one in parallel_map(twice, items, workers)} == {os.getpid()}


def test_worker_error_is_raised_in_order_in_the_caller() -> None:
    results = parallel_map(refuse, range(4), 2)
    assert next(results) == 0
    with pytest.raises(RecordingError, match=r"one\.mcap is damaged"):
        next(results)


def test_killed_process_gives_one_line_error() -> None:
    with pytest.raises(SettingError, match="Try fewer --workers"):
        list(parallel_map(die, range(2), 2))


@pytest.mark.parametrize("after_s", [0.0, 0.01, 0.05])
def test_closing_ends_workers_that_are_sending_an_answer(after_s: float) -> None:
    """The parent must not wait for the rest of an answer that is partly in the pipe."""
    results = parallel_map(return_50_mb, range(9), 2)
    assert len(next(results)) == 50_000_000
    time.sleep(after_s)
    results.close()
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_no_process_outlives_the_one_that_began_it(number: int, tmp_path: Path) -> None:
    there = tmp_path / "there"
    there.mkdir()
    script = tmp_path / "waits.py"
    script.write_text(WAIT_PROGRAM)
    process = subprocess.Popen(
        [sys.executable, str(script), str(there)],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        stderr=subprocess.DEVNULL,
    )
    while len(list(there.iterdir())) < 2:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(number)
    until_s = time.monotonic() + 20
    while [p for p in there.iterdir() if is_running(int(p.name))] and time.monotonic() < until_s:
        time.sleep(0.05)
    left = [p.name for p in there.iterdir() if is_running(int(p.name))]
    process.kill()
    process.wait()
    assert not left


def is_running(number: int) -> bool:
    """Return whether a process exists and is no zombie."""
    try:
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
