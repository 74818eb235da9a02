"""One stage over many recordings: a folder in, a folder out.

A plan is a list of tasks, each an input, an output and a line of JSON. Any process with dmrl and
access to the files can run one. An executor takes the lines: `ProcessPool`, whose
processes are on this machine, or `cluster.Ray`.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from glob import has_magic
from pathlib import Path
from typing import Any

from dmrl.atomic_output import register_output
from dmrl.errors import DmrlError, OutputError, RecordingError, SettingError
from dmrl.guards.paths import require_text_path
from dmrl.pipeline.executor import Executor, open_executor
from dmrl.pipeline.job import JobResult, build_job, has_failed
from dmrl.storage import RemotePath
from dmrl.terminal.left_out import count_so_far
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import count_things, print_json, print_table

MAX_NUMBERS = 4
"""Most numbers of a result in the table."""


@dataclass(frozen=True, slots=True)
class Task:
    """A stage on one input.

    Parameters
    ----------
    source
        Input.
    out
        Output; None: there is none.
    line
        Line for `dmrl.pipeline.job_worker.run_job`.
    """

    source: Path
    out: Path | None
    line: str


def is_collection(source: Path) -> bool:
    """Return whether a path names many recordings: a folder, or a pattern that is no file."""
    return source.is_dir() or (has_magic(str(source)) and not source.exists())


def find_recordings(source: Path, *, but: Path | None = None) -> dict[Path, Path]:
    """Return recordings by their names below a folder, or below the fixed part of a pattern.

    Parameters
    ----------
    source
        A folder, which is searched recursively; a pattern such as ``2024-*/*.mcap``; or a
        recording.
    but
        Folder to leave out, such as that of the outputs.

    Raises
    ------
    RecordingError
        If there is none.
    """
    if source.is_dir():
        base, found = source, _list_below(source, but)
    elif is_collection(source):
        base, found = next(parent for parent in source.parents if not has_magic(str(parent))), []
        for path in sorted(base.glob(str(source.relative_to(base)))):
            if any(part.startswith(".") for part in path.relative_to(base).parts):
                continue
            found += _list_below(path, but) if path.is_dir() else [path]
    else:
        return {Path(source.name): source}
    if not found:
        raise RecordingError(
            f"no recording (.mcap) in {source}. Name another folder, or make one of its files: "
            f"dmrl convert {source} OUT.mcap"
        )
    return {path.relative_to(base): path for path in found}


def find_all_recordings(named: Iterable[Path], query: str | None = None) -> list[Path]:
    """Return the recordings that are named, and all in the folders that are named.

    Parameters
    ----------
    named
        Recordings and folders; with a query, folders that were indexed.
    query
        Condition in SQL; see `dmrl.catalogue.query`. None: all recordings.

    Raises
    ------
    RecordingError
        If a folder has none, or no catalogue, or one of them has changed since it was indexed.
    SettingError
        If the query is wrong, or true of none.
    """
    if query is not None:
        from dmrl.catalogue.query import find_recordings as query_catalogue  # noqa: PLC0415 - an extra

        found = [path for folder in named for path in query_catalogue(folder, query)]
        if not found:
            raise SettingError(f"--from-index {query!r} is true of no recording. Ask: dmrl find")
        return found
    return [path for one in named for path in find_recordings(one).values()]


def _list_below(folder: Path, but: Path | None) -> list[Path]:
    if isinstance(folder, RemotePath):
        return list(_iter_remote(folder, but))
    found = []
    for where, folders, names in os.walk(folder):
        left_out = [n for n in folders if n.startswith(".") or _is_same(Path(where, n), but)]
        folders[:] = sorted(set(folders) - set(left_out))
        whole = (n for n in sorted(names) if n.endswith(".mcap") and not n.startswith("."))
        found += [Path(where, name) for name in whole]
    return found


def _iter_remote(folder: RemotePath, but: Path | None) -> Iterator[Path]:
    for path in folder.rglob("*.mcap"):
        hidden = any(part.startswith(".") for part in path.parts[len(folder.parts) :])
        if not (hidden or (but is not None and path.is_relative_to(but))):
            yield path


def _is_same(path: Path, other: Path | None) -> bool:
    return other is not None and other.exists() and path.samefile(other)


def build_tasks(
    stage: str,
    role: str,
    found: Mapping[Path, Path],
    out: Path | None,
    settings: Any = None,
    inputs: Mapping[str, Path] | None = None,
) -> list[Task]:
    """Return a task for each input.

    Parameters
    ----------
    stage
        Command name.
    role
        Argument of its ``run`` that is the input.
    found
        Inputs by the names of their outputs.
    out
        Folder of the outputs. None: the stage writes nothing.
    settings
        Settings of the stage; None: it has none.
    inputs
        Further inputs, the same for all.
    """
    own = find_changed_settings(settings)
    made = []
    for name, source in found.items():
        place = None if out is None else out / name
        given = {role: source, **(inputs or {})}
        made.append(Task(source, place, build_job(stage, place, given, own, keep=True)))
    return made


def find_changed_settings(settings: Any) -> dict[str, Any]:
    """Return the settings that differ from the defaults, by name."""
    if settings is None:
        return {}
    default = type(settings)()
    pairs = ((f.name, getattr(settings, f.name), getattr(default, f.name)) for f in fields(default))
    return {name: value for name, value, usual in pairs if value != usual}


def iter_results(
    tasks: Sequence[Task], executor: Executor, what: str
) -> Iterator[tuple[Task, JobResult]]:
    """Yield tasks in their order, each with its result as soon as those before it have theirs.

    The largest inputs start first, so that none of them is left at the end.
    """
    by_size = sorted(range(len(tasks)), key=lambda k: _file_size(tasks[k].source), reverse=True)
    answers = {k: executor.submit(tasks[k].line, exclusive=False) for k in by_size}
    for k in track(range(len(tasks)), what, below=executor.list_nodes):
        answer = answers.pop(k).result()
        place = tasks[k].out
        if place is not None and not has_failed(answer):
            register_output(place)
        yield tasks[k], answer


def _file_size(path: Path) -> int:
    if isinstance(path, RemotePath):
        return 0  # to ask would cost a request for each
    try:
        return path.stat().st_size
    except OSError:
        return 0  # the stage itself reports the error


def run_over_folder(
    stage: str,
    source: Path,
    out: Path,
    settings: Any = None,
    *,
    workers: int | None,
    on: str | None = None,
    as_json: bool = False,
    role: str = "recording",
    inputs: Mapping[str, Path] | None = None,
    found: Mapping[Path, Path] | None = None,
) -> None:
    """Run a stage on every recording of a folder, and print the result of each.

    Parameters
    ----------
    stage, role, settings, inputs
        See `build_tasks`.
    source
        A folder of recordings, or a pattern.
    out
        Folder of the outputs, created if missing. Outputs have the names of their inputs; those
        that exist already, made of the same inputs by the same settings, stay.
    workers
        Processes, at most. None: as many as there are cores.
    on
        Cluster that runs the tasks in place of processes here; see `open_executor`.
    as_json
        Print one JSON document in place of the table.
    found
        Inputs by the names of their outputs; without it, the recordings in ``source``.

    Raises
    ------
    DmrlError
        If there is no input, or a task failed, after all others have run.
    """
    if _is_same(source, out):
        raise SettingError(f"{out} is the folder that is read. Name another for what is made")
    found = find_recordings(source, but=out) if found is None else found
    tasks = build_tasks(stage, role, found, out, settings, inputs)
    made = _make_folders(out, tasks)
    with open_executor(on, workers) as crew:
        done = list(iter_results(tasks, crew, f"dmrl {stage}"))
    for folder in made:
        with suppress(OSError):  # it is not empty
            folder.rmdir()
    for task, answer in done:
        result = answer.get("result")
        for warning in result.get("warnings", []) if isinstance(result, dict) else []:
            say(f"{task.source}: {warning}")
    if as_json:
        held = {"left_out": count_so_far()} if count_so_far() else {}
        documents = [_to_document(*one) for one in done]
        print_json({"folder": str(out), **held, "recordings": documents})
    else:
        rows = [
            (task.out, status_word(answer), _summarize(answer.get("result")))
            for task, answer in done
        ]
        print_table(str(out), ("recording", "", "holds"), rows)
    report_failures(done, "; the others are done. Run it again when these are fixed")


def _make_folders(out: Path, tasks: Iterable[Task]) -> list[Path]:
    """Create the folders of all outputs; return the new ones, the deepest first."""
    require_text_path(out)
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out} is a file. Many recordings go into a folder: name one")
    if isinstance(out, RemotePath):
        return []  # a bucket has no folders
    if not out.parent.is_dir():
        raise OutputError(f"no folder {out.parent} to make {out.name} in. Try: mkdir -p {out}")
    wanted = dict.fromkeys(task.out.parent for task in tasks if task.out)
    below = {p for folder in wanted for p in (folder, *folder.parents) if p.is_relative_to(out)}
    made = sorted((p for p in below if not p.exists()), key=lambda p: -len(p.parts))
    for folder in wanted:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            raise OutputError(f"cannot make {folder}: {e.strerror}. Choose another place") from e
    return made


def status_word(answer: JobResult) -> str:
    """Return the outcome of a task, in a word."""
    return "failed" if has_failed(answer) else "was there" if "up_to_date" in answer else "made"


def error_text(task: Task, answer: JobResult) -> str:
    """Return the file and the error of a task that failed."""
    if "bug" in answer:
        return f"{task.source}: internal error, {answer['bug']}. Please report what it printed"
    text = str(answer["error"])
    return text if str(task.source) in text else f"{task.source}: {text}"


def report_failures(done: Sequence[tuple[Task, JobResult]], then: str = "") -> None:
    """Print a line for each task that failed. Raise DmrlError if there is one."""
    bad = [(task, answer) for task, answer in done if has_failed(answer)]
    for task, answer in bad:
        say(f"failed: {error_text(task, answer)}")
    if bad:
        raise DmrlError(f"{len(bad)} of {len(done)} recordings failed{then}")


def _to_document(task: Task, answer: JobResult) -> dict[str, Any]:
    told = {"recording": str(task.source), "out": str(task.out), "state": status_word(answer)}
    if has_failed(answer):
        return {**told, "error": error_text(task, answer)}
    return told | {key: answer[key] for key in ("result", "left_out") if key in answer}


def _summarize(result: Any) -> str:
    """Return the numbers of a result as text; for counts by topic, their sum."""
    if isinstance(result, int):
        return count_things(result, "message")
    found = result.items() if isinstance(result, dict) else ()
    numbers = {name: value for name, value in found if isinstance(value, int | float)}
    if any(name.startswith("/") for name in numbers):
        return count_things(int(sum(numbers.values())), "message")
    return ", ".join(f"{name} {value}" for name, value in list(numbers.items())[:MAX_NUMBERS])
