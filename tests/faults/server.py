"""The process with everything loaded, which forks for each command. Started by disk.py."""

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

from .disk import small_files
from .ending import ended
from .workloads import READS, WORKLOADS, Inputs, find_workload

HANG_S = 300
"""A command that takes longer hangs, on a machine however busy."""


def main(folder: str) -> None:
    """Answer jobs, a line each, until there are no more."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    inputs, told_in = Inputs(Path(folder) / "inputs"), Path(folder) / "answer"
    inputs.folder.mkdir()
    for line in sys.stdin:
        answer = in_a_child(json.loads(line), inputs, told_in)
        _load(answer.pop("modules", []))
        print(json.dumps(answer), file=answers, flush=True)


def in_a_child(told: dict[str, Any], inputs: Inputs, told_in: Path) -> dict[str, Any]:
    """What a function gave, or how it ended; what it loaded, which the next then need not."""
    begun_s = time.monotonic()
    told_in.unlink(missing_ok=True)
    gc.freeze()  # a collection in the child would copy every page
    number = os.fork()
    if number == 0:
        _child(told, inputs, told_in)
    if told["kill_s"] is not None:
        watched = os.pidfd_open(number)
        select.select([watched], [], [], told["kill_s"])
        os.close(watched)
        os.kill(number, signal.SIGKILL)  # nobody has waited for it: the number is still its own
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


def _child(told: dict[str, Any], inputs: Inputs, told_in: Path) -> None:
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
    """How a work ended."""
    run = find_workload(work).run
    with small_files(most_bytes):
        return ended(lambda: run(inputs, Path(out)))


def run_mute(inputs: Inputs, work: str, out: str, stream: str) -> tuple[int, str]:
    """How a work ended whose standard output is "full" or "closed"."""
    os.close(1)
    if stream == "full":
        os.open("/dev/full", os.O_WRONLY)
    sys.stdout = None  # type: ignore[assignment]
    open_standard_streams()
    kept = sys.stdout  # a child that forgets it would close 1, where it answers
    run = (READS | {one.name: one.run for one in WORKLOADS})[work]
    try:
        return ended(lambda: run(inputs, Path(out)), mute=True)
    finally:
        del kept


def run_together(inputs: Inputs, work: str, out: str, times: int) -> list[tuple[int, str]]:
    """How a work ended that is run several times at once, in processes of their own."""
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
    """Make what has to be there before it."""
    before = find_workload(work).before
    if before is not None:
        before(inputs, Path(out))


def _load(names: list[str]) -> None:
    """Load what a child had to, so that the next need not; rerun's threads would not be there."""
    for name in names:
        if name not in sys.modules and not name.startswith("rerun"):
            with warnings.catch_warnings(), suppress(Exception):
                warnings.simplefilter("ignore")
                importlib.import_module(name)
