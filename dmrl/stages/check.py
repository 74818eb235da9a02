"""``dmrl check``: findings about recordings."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmrl.errors import SettingError
from dmrl.pipeline.batch import (
    Task,
    build_tasks,
    error_text,
    find_all_recordings,
    is_collection,
    iter_results,
    report_failures,
)
from dmrl.pipeline.executor import Executor, open_executor
from dmrl.pipeline.job import JobResult, has_failed
from dmrl.terminal.arguments import AsJson, In, On, Workers
from dmrl.terminal.tables import print_json, print_line

if TYPE_CHECKING:
    from dmrl.recording import Finding


@dataclass(frozen=True, slots=True)
class Checked:
    """Size of a recording, and the findings of its checks."""

    messages: int
    topics: int
    findings: "list[Finding]"


def run(recording: Path) -> Checked:
    """Check a recording.

    Raises
    ------
    RecordingError
        If it is not a complete recording.
    """
    from dmrl.recording import check, read_summary

    findings, held = check(recording), read_summary(recording)
    return Checked(held.count, len(held.topics), findings)


def command(
    *recordings: In,
    workers: Workers = None,
    on: On = None,
    as_json: AsJson = False,
) -> int:
    """Check a recording: schemas, times, gaps, calibration, labels.

    Exit status 1 if there are errors; warnings alone leave it 0.

    Parameters
    ----------
    recordings
        A recording; or several, folders of them, or patterns in quotes: then one line for each.
    workers
        Recordings at a time, at most. Without it, as many as there are cores.
    """
    if not recordings:
        raise SettingError("check wants a recording, or a folder of them. Name one")
    if len(recordings) > 1 or is_collection(recordings[0]) or on is not None:
        return _check_side_by_side(recordings, open_executor(on, workers), as_json=as_json)
    found = run(recordings[0])
    errors = sum(f.level == "error" for f in found.findings)
    if as_json:
        told = [asdict(f) for f in found.findings]
        print_json({"recording": recordings[0].name, "findings": told})
        return 1 if errors else 0
    for finding in found.findings:
        where = f" {finding.topic}:" if finding.topic else ""
        print_line(f"{finding.level}:{where} {finding.text}")
    print_line(
        f"{recordings[0]}: {found.messages} messages on {found.topics} topics, "
        f"{errors} errors, {len(found.findings) - errors} warnings"
    )
    return 1 if errors else 0


def _check_side_by_side(named: Sequence[Path], crew: Executor, *, as_json: bool) -> int:
    """Check recordings side by side; return 1 if one has an error or cannot be read."""
    found = {path: path for path in find_all_recordings(named)}
    tasks = build_tasks("check", "recording", found, None)
    done: list[tuple[Task, JobResult]] = []
    with crew:
        for task, answer in iter_results(tasks, crew, "Checking"):
            done.append((task, answer))
    documents = sorted((_document(task, answer) for task, answer in done), key=_badness)
    for one in documents:
        if not as_json and "error" not in one:
            print_line(f"{one['recording']}: {_summary_line(one)}")
    errors, warnings = (
        sum(one["level"] == level for each in documents for one in each["findings"])
        for level in ("error", "warning")
    )
    sound = sum(_is_sound(one) for one in documents)
    if as_json:
        totals = {"sound": sound, "errors": errors, "warnings": warnings}
        print_json({"recordings": documents, **totals})
    else:
        print_line(
            f"{len(documents)} recordings: {sound} without errors; {errors} errors, "
            f"{warnings} warnings"
        )
    report_failures(done)
    return 0 if sound == len(documents) else 1


def _badness(document: dict[str, Any]) -> tuple[int, int, str]:
    """Return the order of a recording: worst first, then by name."""
    levels = [one["level"] for one in document["findings"]]
    unread = 10**6 if "error" in document else 0
    return -unread - levels.count("error"), -levels.count("warning"), document["recording"]


def _is_sound(document: dict[str, Any]) -> bool:
    """Return whether a recording could be read and has no error."""
    wrong = any(one["level"] == "error" for one in document["findings"])
    return not (wrong or "error" in document)


def _summary_line(found: dict[str, Any]) -> str:
    """Return the size of a recording and its worst finding, in one line."""
    findings = found["findings"]
    errors = sum(one["level"] == "error" for one in findings)
    worst = ""
    if findings:
        where = f"{findings[0]['topic']}: " if findings[0]["topic"] else ""
        worst = f"; {findings[0]['level']}: {where}{findings[0]['text']}"
    return (
        f"{found['messages']} messages on {found['topics']} topics, {errors} errors, "
        f"{len(findings) - errors} warnings{worst}"
    )


def _document(task: Task, answer: JobResult) -> dict[str, Any]:
    named = {"recording": str(task.source)}
    if has_failed(answer):
        return {**named, "error": error_text(task, answer), "findings": []}
    return {**named, **answer["result"]}
