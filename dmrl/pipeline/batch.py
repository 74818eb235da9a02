"""One stage over many recordings: a folder in, a folder out.

What is to be done is a plan: a list of tasks, each an input, an output and a line of JSON. Any
process that has dmrl and sees the files can do one. An executor takes the lines: `Crew`, whose
processes are on this machine, or `cluster.Ray`; or an array job of Slurm does them.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from glob import has_magic
from pathlib import Path
from typing import Any

from dmrl.atomic_output import note
from dmrl.errors import DmrlError, OutputError, RecordingError, SettingError
from dmrl.guards.paths import refuse_no_text
from dmrl.pipeline.cluster.slurm import array_job
from dmrl.pipeline.executor import SLURM, Executor, executor
from dmrl.pipeline.job import Answer, failed, job
from dmrl.storage import Remote
from dmrl.terminal.progress import say, track
from dmrl.terminal.tables import print_json, print_line, print_table

MOST_WORDS = 4
"""Of a result in the table."""


@dataclass(frozen=True, slots=True)
class Task:
    """A stage on one input.

    Parameters
    ----------
    source
        What it is about.
    out
        What it writes; None: nothing.
    line
        As `dmrl.pipeline.job_worker.perform` takes it.
    """

    source: Path
    out: Path | None
    line: str


def is_many(source: Path) -> bool:
    """Whether a name is of many recordings: a folder, or a pattern that no file is called."""
    return source.is_dir() or (has_magic(str(source)) and not source.exists())


def recordings_in(source: Path, *, but: Path | None = None) -> dict[Path, Path]:
    """Recordings by what they are called below a folder, or before a pattern's first sign.

    Parameters
    ----------
    source
        A folder, which is searched to its depths; a pattern such as ``2024-*/*.mcap``; or a
        recording.
    but
        A folder that is left out: of the outputs.

    Raises
    ------
    RecordingError
        If there is none.
    """
    if source.is_dir():
        base, found = source, _below(source, but)
    elif is_many(source):
        base, found = _before_signs(source), []
        for path in sorted(base.glob(str(source.relative_to(base)))):
            if any(part.startswith(".") for part in path.relative_to(base).parts):
                continue
            found += _below(path, but) if path.is_dir() else [path]
    else:
        return {Path(source.name): source}
    if not found:
        raise RecordingError(f"no recording (.mcap) in {source}. Name another folder")
    return {path.relative_to(base): path for path in found}


def all_recordings(named: Iterable[Path], query: str | None = None) -> list[Path]:
    """Recordings that are named, and all in the folders that are named.

    Parameters
    ----------
    named
        Recordings and folders; with a query, folders that were indexed.
    query
        Only those that this is true of; see `dmrl.catalogue.query`.

    Raises
    ------
    RecordingError
        If a folder has none, or no catalogue, or one of them has changed since it was indexed.
    SettingError
        If the query is wrong, or true of none.
    """
    if query is not None:
        from dmrl.catalogue.query import found_in  # noqa: PLC0415 - an extra

        found = [path for folder in named for path in found_in(folder, query)]
        if not found:
            raise SettingError(f"--from-index {query!r} is true of no recording. Ask: dmrl find")
        return found
    return [path for one in named for path in recordings_in(one).values()]


def _below(folder: Path, but: Path | None) -> list[Path]:
    if isinstance(folder, Remote):
        return list(_remote(folder, but))
    found = []
    for where, folders, names in os.walk(folder):
        left_out = [n for n in folders if n.startswith(".") or _same(Path(where, n), but)]
        folders[:] = sorted(set(folders) - set(left_out))
        whole = (n for n in sorted(names) if n.endswith(".mcap") and not n.startswith("."))
        found += [Path(where, name) for name in whole]
    return found


def _remote(folder: Remote, but: Path | None) -> Iterator[Path]:
    for path in folder.rglob("*.mcap"):
        hidden = any(part.startswith(".") for part in path.parts[len(folder.parts) :])
        if not (hidden or (but is not None and path.is_relative_to(but))):
            yield path


def _same(path: Path, other: Path | None) -> bool:
    return other is not None and other.exists() and path.samefile(other)


def _before_signs(pattern: Path) -> Path:
    """The folder that all of a pattern's files lie below."""
    return next(parent for parent in pattern.parents if not has_magic(str(parent)))


def tasks_of(
    stage: str,
    role: str,
    found: Mapping[Path, Path],
    out: Path | None,
    settings: Any = None,
    inputs: Mapping[str, Path] | None = None,
) -> list[Task]:
    """A task for each input.

    Parameters
    ----------
    stage
        Command name.
    role
        The argument of its ``run`` that takes one of them.
    found
        Inputs by the names of their outputs.
    out
        Folder of the outputs. None: it writes nothing.
    settings
        Its settings; None: it has none.
    inputs
        What all of them read besides.
    """
    own = differing(settings)
    made = []
    for name, source in found.items():
        place = None if out is None else out / name
        given = {role: source, **(inputs or {})}
        made.append(Task(source, place, job(stage, place, given, own, keep=True)))
    return made


def differing(settings: Any) -> dict[str, Any]:
    """Settings that are not the default ones, by name."""
    if settings is None:
        return {}
    default = type(settings)()
    pairs = ((f.name, getattr(settings, f.name), getattr(default, f.name)) for f in fields(default))
    return {name: value for name, value, usual in pairs if value != usual}


def outcomes(tasks: Sequence[Task], executor: Executor, what: str) -> Iterator[tuple[Task, Answer]]:
    """Tasks in their order, each with its answer as soon as those before it are there.

    The largest inputs are begun first, so that no one of them is waited for at the end.
    """
    by_size = sorted(range(len(tasks)), key=lambda k: _size(tasks[k].source), reverse=True)
    answers = {k: executor.give(tasks[k].line, alone=False) for k in by_size}
    for k in track(range(len(tasks)), what, below=executor.nodes):
        answer = answers.pop(k).result()
        place = tasks[k].out
        if place is not None and not failed(answer):
            note(place)
        yield tasks[k], answer


def _size(path: Path) -> int:
    if isinstance(path, Remote):
        return 0  # to ask would cost a request for each
    try:
        return path.stat().st_size
    except OSError:
        return 0  # what it is about says so itself


def over_folder(
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
    """Run a stage on every recording of a folder, and print what came of each.

    Parameters
    ----------
    stage, role, settings, inputs
        See `tasks_of`.
    source
        A folder of recordings, or a pattern.
    out
        Folder of the outputs, made if it is not there. They have the names of their inputs; those
        that are there, made of the same inputs by the same settings, are left as they are.
    workers
        Processes, at most. None: as many as there are cores.
    on
        A cluster that does it in place of processes here; see `executor`. "slurm": a job for it is
        written, and nothing is done yet.
    as_json
        Print one JSON document in place of the table.
    found
        Inputs by the names of their outputs; without it, the recordings in ``source``.

    Raises
    ------
    DmrlError
        If there is nothing to do, or some of it failed; then after everything else was done.
    """
    if _same(source, out):
        raise SettingError(f"{out} is the folder that is read. Name another for what is made")
    found, out = _named(source, out) if found is None else (found, out)
    tasks = tasks_of(stage, role, found, out, settings, inputs)
    made = _make_folders(out, tasks)
    if on == SLURM:
        print_line(array_job(tasks, out))
        return
    with executor(on, workers) as crew:
        done = list(outcomes(tasks, crew, f"dmrl {stage}"))
    for folder in made:
        with suppress(OSError):  # it holds something
            folder.rmdir()
    for task, answer in done:
        for warning in _part(answer.get("result"), "warnings"):
            say(f"{task.source}: {warning}")
    if as_json:
        print_json({"folder": str(out), "recordings": [_document(*one) for one in done]})
    else:
        rows = [(task.out, came_of(answer), _brief(answer.get("result"))) for task, answer in done]
        print_table(str(out), ("recording", "", "holds"), rows)
    end(done, "; the others are there. Run it again when these are mended")


def _named(source: Path, out: Path) -> tuple[Mapping[Path, Path], Path]:
    """Inputs by the names of their outputs, and the folder of these."""
    if is_many(source):
        return recordings_in(source, but=out), out
    return {Path(out.name): source}, out.parent


def _make_folders(out: Path, tasks: Iterable[Task]) -> list[Path]:
    """Make the folders of all outputs; those that were not there, the deepest first."""
    refuse_no_text(out)
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out} is a file. Many recordings go into a folder: name one")
    if isinstance(out, Remote):
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


def came_of(answer: Answer) -> str:
    """What came of a task, in a word."""
    return "failed" if failed(answer) else "was there" if "there" in answer else "made"


def words_of(task: Task, answer: Answer) -> str:
    """What is to be said of a task that failed: its file, and why."""
    if "fault" in answer:
        return f"{task.source}: internal error, {answer['fault']}. Please report what it printed"
    text = str(answer["error"])
    return text if str(task.source) in text else f"{task.source}: {text}"


def end(done: Sequence[tuple[Task, Answer]], then: str = "") -> None:
    """Say what failed, a line each.

    Raises
    ------
    DmrlError
        If anything has.
    """
    bad = [(task, answer) for task, answer in done if failed(answer)]
    for task, answer in bad:
        say(f"failed: {words_of(task, answer)}")
    if bad:
        raise DmrlError(f"{len(bad)} of {len(done)} recordings failed{then}")


def _document(task: Task, answer: Answer) -> dict[str, Any]:
    told = {"recording": str(task.source), "out": str(task.out), "state": came_of(answer)}
    if failed(answer):
        return {**told, "error": words_of(task, answer)}
    return told if "there" in answer else {**told, "result": answer["result"]}


def _part(result: Any, name: str) -> list[str]:
    return result.get(name, []) if isinstance(result, dict) else []


def _brief(result: Any) -> str:
    """Numbers of a result that stand by themselves; of counts by topic, their sum."""
    if isinstance(result, int):
        return f"{result} messages"
    found = result.items() if isinstance(result, dict) else ()
    numbers = {name: value for name, value in found if isinstance(value, int | float)}
    if any(name.startswith("/") for name in numbers):
        return f"{sum(numbers.values())} messages"
    return ", ".join(f"{name} {value}" for name, value in list(numbers.items())[:MOST_WORDS])
