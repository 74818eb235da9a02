"""The process that disk.py starts: it keeps all modules loaded and forks for each command."""

import gc
import importlib
import json
import os
import select
import signal
import sys
import time
import traceback
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

from dmrl.boundary import open_standard_streams

from .disk import limit_file_size
from .ending import run_to_end
from .workloads import READS, WORKLOADS, Inputs, find_workload

HANG_S = 300
"""A command that takes longer counts as hanging, even on a busy machine."""


def main(folder: str) -> None:
    """Answer jobs, one per line of standard input, until it ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # keeps what libraries print out of the answers
    inputs, told_in = Inputs(Path(folder) / "inputs"), Path(folder) / "answer"
    inputs.folder.mkdir()
    for line in sys.stdin:
        answer = run_in_child(json.loads(line), inputs, told_in)
        _load(answer.pop("modules", []))
        print(json.dumps(answer), file=answers, flush=True)


def run_in_child(told: dict[str, Any], inputs: Inputs, told_in: Path) -> dict[str, Any]:
    """Run a job in a child; return its result or fault, and the modules that it loaded."""
    begun_s = time.monotonic()
    told_in.unlink(missing_ok=True)
    gc.freeze()  # a collection in the child would copy every page
    number = os.fork()
    if number == 0:
        _answer_job(told, inputs, told_in)
    if told["kill_s"] is not None:
        watched = os.pidfd_open(number)
        select.select([watched], [], [], told["kill_s"])
        os.close(watched)
        os.kill(number, signal.SIGKILL)  # before wait4 the process ID cannot be reused
    _, ended_as, used = os.wait4(number, 0)
    status = os.waitstatus_to_exitcode(ended_as)
    answer: dict[str, Any] = {"value": None}
    if status == 0 and told_in.exists():
        answer = json.loads(told_in.read_bytes())
    elif status == -signal.SIGALRM:
        answer = {"fault": f"no end after {HANG_S} s"}
    elif status != -signal.SIGKILL:
        answer = {"fault": f"ended with {status}"}
    return {**answer, "seconds": time.monotonic() - begun_s, "rss_kb": used.ru_maxrss}


def _answer_job(told: dict[str, Any], inputs: Inputs, told_in: Path) -> None:
    """Call the function of a job, write its result or traceback to a file, and exit."""
    answer: dict[str, Any]
    try:
        signal.alarm(HANG_S)
        module, name = told["call"].split(":")
        call = getattr(importlib.import_module(f".{module}", __package__), name)
        answer = {"value": call(inputs, **told["given"]), "modules": list(sys.modules)}
    except BaseException:
        answer = {"fault": traceback.format_exc()}
    told_in.write_bytes(json.dumps(answer).encode())
    os._exit(0)


def run_work(inputs: Inputs, work: str, out: str, most_bytes: int | None) -> tuple[int, str]:
    """Run a workload; return its exit status and error line."""
    run = find_workload(work).run
    with limit_file_size(most_bytes):
        return run_to_end(lambda: run(inputs, Path(out)))


def run_without_stdout(inputs: Inputs, work: str, out: str, stream: str) -> tuple[int, str]:
    """Run a workload whose standard output is "full" or "closed"; return status and error line."""
    os.close(1)
    if stream == "full":
        os.open("/dev/full", os.O_WRONLY)
    sys.stdout = None  # type: ignore[assignment]
    open_standard_streams()
    kept = sys.stdout  # garbage collection of it would close descriptor 1
    run = (READS | {one.name: one.run for one in WORKLOADS})[work]
    try:
        return run_to_end(lambda: run(inputs, Path(out)), mute=True)
    finally:
        del kept


def run_together(inputs: Inputs, work: str, out: str, times: int) -> list[tuple[int, str]]:
    """Run a workload in several processes at once; return status and error line of each."""
    ears = []
    for _ in range(times):
        ear, mouth = os.pipe()
        ears.append(ear)
        if os.fork() == 0:
            answer: list[object] = [70, ""]
            try:
                answer = list(run_work(inputs, work, out, None))
            except BaseException:
                answer[1] = traceback.format_exc()
            os.write(mouth, json.dumps(answer).encode())
            os._exit(0)
        os.close(mouth)
    answers = []
    for ear in ears:
        with os.fdopen(ear, "rb") as stream:
            status, said = json.loads(stream.read())
            answers.append((status, said))
    return answers


def prepare_work(inputs: Inputs, work: str, out: str) -> None:
    """Make what a workload needs before it starts."""
    before = find_workload(work).before
    if before is not None:
        before(inputs, Path(out))


def _load(names: list[str]) -> None:
    """Load the modules that a child loaded, except rerun: its threads would not survive a fork."""
    for name in names:
        if name not in sys.modules and not name.startswith("rerun"):
            with warnings.catch_warnings(), suppress(Exception):
                warnings.simplefilter("ignore")
                importlib.import_module(name)
