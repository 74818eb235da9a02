"""A process that runs steps: one job a line on standard input, one answer a line back.

Started by `crew`; nobody calls it by hand. It dies with the
process that started it, and takes with it what its stage has started.
"""

import json
import os
import queue
import signal
import sys
import threading
import traceback
from pathlib import Path
from typing import Any

from dmrl import recipe as recipes
from dmrl.errors import DmrlError
from dmrl.pipeline.interface import Interface, interface_of
from dmrl.recording.inputs import sha256_of_file, sha256_of_folder

Answer = dict[str, str]


def job(
    stage: str, out: Path, inputs: dict[str, Any], settings: dict[str, Any], *, resume: bool
) -> str:
    """One line that `perform` understands."""
    told = {"stage": stage, "out": out, "inputs": inputs, "settings": settings, "resume": resume}
    return json.dumps(told, default=str)


def perform(line: str) -> Answer:
    """Run a step: the SHA-256 of its output, what a user can mend, or that dmrl has a fault."""
    told = json.loads(line)
    out = Path(told["out"])
    try:
        takes = interface_of(told["stage"])
        takes.run(**_arguments(told, takes), out=out)
        return {"sha256": sha256_of_folder(out) if out.is_dir() else sha256_of_file(out)}
    except DmrlError as e:
        return {"error": str(e)}
    except Exception as e:
        traceback.print_exc()
        return {"fault": f"{type(e).__name__}: {e}"}


def _arguments(told: dict[str, Any], takes: Interface) -> dict[str, Any]:
    found: dict[str, Any] = {
        role: [Path(one) for one in given] if isinstance(given, list) else Path(given)
        for role, given in told["inputs"].items()
    }
    given = dict(told["settings"])
    for name, hint in takes.others.items():
        found[name] = recipes.argument(given.pop(name), hint)
    if takes.settings is not None:
        found["settings"] = recipes.check(told["stage"], given, takes.settings)
    if takes.resumes:
        found["resume"] = told["resume"]
    return found


def main() -> None:
    """Answer jobs until there are no more."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    signal.signal(signal.SIGINT, signal.default_int_handler)
    jobs: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(jobs,), daemon=True).start()
    print("ready", file=answers, flush=True)
    try:
        while True:
            print(json.dumps(perform(jobs.get())), file=answers, flush=True)
    except KeyboardInterrupt:
        os._exit(130)


def _listen(jobs: "queue.SimpleQueue[str]") -> None:
    for line in sys.stdin:
        jobs.put(line)
    # Whoever gave us work is gone, perhaps killed: nobody would ever move what we write.
    os.killpg(0, signal.SIGKILL)
