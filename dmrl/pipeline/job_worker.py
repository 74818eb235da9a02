"""Worker process: reads a job per line on standard input, and prints a result per line.

Started by `process_pool`. It ends with the process that started it, and with it all processes
that its stage has started.
"""

import gc
import json
import os
import queue
import signal
import sys
import threading
import traceback
from dataclasses import asdict, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

from dmrl import recipe as recipes
from dmrl.errors import BusyOutput, FullDisk, MissingExtra, OutputError, describe_error
from dmrl.pipeline.job import JobResult, has_failed
from dmrl.pipeline.recipe_language import iter_leaves
from dmrl.pipeline.stage_signature import StageSignature, signature_of
from dmrl.recording import Provenance, build_provenance
from dmrl.recording.provenance_inputs import build_input, hash_file, hash_folder
from dmrl.storage import to_path
from dmrl.terminal.left_out import count_left_out


def run_job(line: str) -> JobResult:
    """Run a job; return its result, an error that the user can fix, or a bug of dmrl."""
    told = json.loads(line)
    out = to_path(told["out"]) if told["out"] else None
    try:
        takes = signature_of(told["stage"], writes=out is not None)
        given = _parse_arguments(told, takes)
        if out is None:
            return {"result": _to_json(takes.run(**given))}
        if told["keep"] and out.exists():
            _require_same_origin(out, told["stage"], takes, given)
            return {"up_to_date": True}
        with count_left_out(strict=getattr(given.get("settings"), "strict", False)) as left_out:
            result = takes.run(**given, out=out)
        if told["keep"]:
            more = {"left_out": dict(left_out.counts)} if left_out.counts else {}
            return {"result": _to_json(result), **more}
        return {"sha256": hash_folder(out) if out.is_dir() else hash_file(out)}
    except BusyOutput as e:
        return {"error": str(e), "retry": "later"}
    except (FullDisk, MissingExtra) as e:
        return {"error": str(e), "retry": "elsewhere"}
    except Exception as e:
        if words := describe_error(e):
            return {"error": words}
        traceback.print_exc()
        return {"bug": f"{type(e).__name__}: {e}"}


def _parse_arguments(told: dict[str, Any], takes: StageSignature) -> dict[str, Any]:
    found: dict[str, Any] = {
        role: [to_path(one) for one in given] if isinstance(given, list) else to_path(given)
        for role, given in told["inputs"].items()
    }
    given = dict(told["settings"])
    for name, hint in takes.others.items():
        found[name] = recipes.to_argument(given.pop(name), hint)
    if takes.settings is not None:
        found["settings"] = recipes.check(told["stage"], given, takes.settings)
    if takes.resumes:
        found["resume"] = told["resume"]
    return found


def _to_json(result: Any) -> Any:
    """Return the result of a stage as JSON values."""

    def plain(value: Any) -> Any:
        return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)

    return json.loads(json.dumps(result, default=plain))


def _require_same_origin(
    out: Path, stage: str, takes: StageSignature, given: dict[str, Any]
) -> None:
    """Raise OutputError unless the provenance of an output names these inputs and settings."""
    made = build_input(out).provenance
    wanted = (takes.origin or partial(_build_origin, stage, takes))(**given)
    same = (
        made is not None
        and made.stage == wanted.stage
        and {one.sha256 for one in wanted.inputs} <= {one.sha256 for one in made.inputs}
        and wanted.settings.items() <= made.settings.items()
    )
    if not same:
        raise OutputError(
            f"{out} exists, and its provenance names other inputs or settings. "
            "Remove it, or name another folder"
        )


def _build_origin(stage: str, takes: StageSignature, **given: Any) -> Provenance:
    """Build the provenance of an output from all inputs and settings of its stage."""
    settings = given.get("settings")
    values = [given[role] for role in takes.roles if role in given]
    values += [getattr(settings, name) for name in takes.paths]
    paths = [path for path in iter_leaves(values, Path) if path.exists()]
    return build_provenance(stage, settings, paths)


def main() -> None:
    """Run jobs until there are no more."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # the output of a library is no result
    signal.signal(signal.SIGINT, signal.default_int_handler)
    jobs: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_read_jobs, args=(jobs,), daemon=True).start()
    print("ready", file=answers, flush=True)
    try:
        while True:
            answer = run_job(jobs.get())
            if has_failed(answer):
                gc.collect()  # a cycle would hold the files and locks of the failed stage
            print(json.dumps(answer), file=answers, flush=True)
    except KeyboardInterrupt:
        pass
    # Only after the exception has gone, with the frames that hold unfinished outputs.
    os._exit(130)


def _read_jobs(jobs: "queue.SimpleQueue[str]") -> None:
    for line in sys.stdin:
        jobs.put(line)
    # The parent has ended, perhaps killed: nobody would use the outputs.
    if hasattr(os, "killpg"):
        os.killpg(0, signal.SIGKILL)
    os._exit(1)
