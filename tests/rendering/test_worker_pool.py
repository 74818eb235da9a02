"""Worker processes: their protocol, the order of results, and deaths of workers."""

import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from dmrl.errors import BlenderError
from dmrl.rendering import worker_pool
from dmrl.rendering.blender import protocol
from dmrl.rendering.worker_pool import Worker, WorkerPool, WorkerStart

# This worker doubles numbers. It dies at the first 5, and at every 13.
FAKE = f"""
import os, sys
sys.path.insert(0, {str(Path(protocol.__file__).parent)!r})
import numpy as np
from pathlib import Path
from protocol import receive, send
head, arrays = receive(sys.stdin.buffer)
died = Path(head["died"])
if head["model"] == "bad":
    send(sys.stdout.buffer, {{"error": "bad is no model"}})
    sys.exit()
send(sys.stdout.buffer, {{"version": "fake"}}, {{"points": np.zeros((1, 3))}})
while True:
    try:
        head, arrays = receive(sys.stdin.buffer)
    except EOFError:
        break
    number = head["number"]
    if number == 13 or (number == 5 and not died.exists()):
        died.touch()
        os._exit(7)
    send(sys.stdout.buffer, {{}}, {{"out": arrays["in"] * 2}})
"""


@pytest.fixture
def worker_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> WorkerStart:
    """Return the command and settings that start the fake worker."""
    script = tmp_path / "worker.py"
    script.write_text(FAKE)
    monkeypatch.setattr(worker_pool, "WORKER_SCRIPT", script)
    return WorkerStart(Path(sys.executable), {"died": str(tmp_path / "died"), "model": None})


def double(worker: Worker, number: int) -> float:
    """Let a worker double a number."""
    _, arrays = worker.request({"number": number}, {"in": np.array([float(number)])})
    return float(arrays["out"][0])


def test_worker_messages_round_trip() -> None:
    stream = BytesIO()
    arrays = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros((0, 4), np.int64)}
    protocol.send(stream, {"name": "ü", "n": [1, 2]}, arrays)
    stream.seek(0)
    head, back = protocol.receive(stream)
    assert head == {"name": "ü", "n": [1, 2]}
    assert all(np.array_equal(back[k], arrays[k]) for k in arrays)
    with pytest.raises(EOFError):
        protocol.receive(stream)


@pytest.mark.heavy
def test_a_dead_worker_is_replaced_and_its_job_repeated(worker_start: WorkerStart) -> None:
    with WorkerPool(worker_start, 2) as workers:
        assert list(workers.map(double, range(12))) == [2.0 * k for k in range(12)]
        assert workers.replaced == 1


@pytest.mark.heavy
def test_no_worker_outlives_a_pool_that_is_left_early(worker_start: WorkerStart) -> None:
    with pytest.raises(KeyError), WorkerPool(worker_start, 4) as workers:
        for k, _ in enumerate(workers.map(double, range(100))):
            if k == 2:
                started = workers.pids
                raise KeyError
    assert started
    assert not [pid for pid in {*started, *workers.pids} if Path(f"/proc/{pid}").exists()]


@pytest.mark.heavy
def test_a_job_that_kills_every_worker_is_an_error(worker_start: WorkerStart) -> None:
    with WorkerPool(worker_start, 1) as workers, pytest.raises(BlenderError, match="died 3 times"):
        list(workers.map(double, [1, 13]))


@pytest.mark.heavy
def test_worker_error_about_a_model_is_raised(worker_start: WorkerStart) -> None:
    worker_start.head["model"] = "bad"
    with pytest.raises(BlenderError, match="bad is no model"):
        WorkerPool(worker_start, 1)


def test_worker_that_fails_to_start_reports_the_reason(worker_start: WorkerStart) -> None:
    worker_pool.WORKER_SCRIPT.write_text("import nothing_of_that_name")
    with pytest.raises(BlenderError, match=r"nothing_of_that_name.*dmrl render --setup"):
        WorkerPool(worker_start, 1)
