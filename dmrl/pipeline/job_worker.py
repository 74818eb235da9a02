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
from collections.abc import Iterator
from dataclasses import asdict, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

from dmrl import recipe as recipes
from dmrl.errors import BusyOutput, FullDisk, MissingExtra, OutputError, words_of
from dmrl.pipeline.job import Answer
from dmrl.pipeline.stage_signature import Interface, interface_of
from dmrl.recording import Provenance, provenance
from dmrl.recording.provenance_inputs import input_of, sha256_of_file, sha256_of_folder
from dmrl.storage import path_of


def perform(line: str) -> Answer:
    """Run a step: what came of it, what a user can mend, or that dmrl has a fault."""
    told = json.loads(line)
    out = path_of(told["out"]) if told["out"] else None
    try:
        takes = interface_of(told["stage"], writes=out is not None)
        given = _arguments(told, takes)
        if out is None:
            return {"result": _plain(takes.run(**given))}
        if told["keep"] and out.exists():
            _require_same(out, told["stage"], takes, given)
            return {"there": True}
        result = takes.run(**given, out=out)
        if told["keep"]:
            return {"result": _plain(result)}
        return {"sha256": sha256_of_folder(out) if out.is_dir() else sha256_of_file(out)}
    except BusyOutput as e:
        return {"error": str(e), "again": "later"}
    except (FullDisk, MissingExtra) as e:
        return {"error": str(e), "again": "elsewhere"}
    except Exception as e:
        if words := words_of(e):
            return {"error": words}
        traceback.print_exc()
        return {"fault": f"{type(e).__name__}: {e}"}


def _arguments(told: dict[str, Any], takes: Interface) -> dict[str, Any]:
    found: dict[str, Any] = {
        role: [path_of(one) for one in given] if isinstance(given, list) else path_of(given)
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


def _plain(result: Any) -> Any:
    """What a stage gives back, as values of JSON."""

    def plain(value: Any) -> Any:
        return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)

    return json.loads(json.dumps(result, default=plain))


def _require_same(out: Path, stage: str, takes: Interface, given: dict[str, Any]) -> None:
    """Nothing, if an output was made of these inputs by these settings, as it says itself.

    Raises
    ------
    OutputError
        If not, or if it does not say.
    RecordingError
        If it is not whole.
    """
    made = input_of(out).provenance
    wanted = (takes.origin or partial(_origin, stage, takes))(**given)
    same = (
        made is not None
        and made.stage == wanted.stage
        and {one.sha256 for one in wanted.inputs} <= {one.sha256 for one in made.inputs}
        and wanted.settings.items() <= made.settings.items()
    )
    if not same:
        raise OutputError(
            f"{out} exists, and does not say that it was made of the same by the same settings. "
            "Remove it, or name another folder"
        )


def _origin(stage: str, takes: Interface, **given: Any) -> Provenance:
    """Provenance of what a stage would write, of everything that it is given to read."""
    settings = given.get("settings")
    values = [given[role] for role in takes.roles if role in given]
    values += [getattr(settings, name) for name in takes.paths]
    return provenance(stage, settings, [path for path in _paths(values) if path.exists()])


def _paths(value: Any) -> Iterator[Path]:
    if isinstance(value, Path):
        yield value
    elif isinstance(value, dict | list | tuple):
        for one in value.values() if isinstance(value, dict) else value:
            yield from _paths(one)


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
        pass
    # Not before the exception is gone, and with it the frames that hold what is half written.
    os._exit(130)


def _listen(jobs: "queue.SimpleQueue[str]") -> None:
    for line in sys.stdin:
        jobs.put(line)
    # Whoever gave us work is gone, perhaps killed: nobody would ever move what we write.
    os.killpg(0, signal.SIGKILL)
