"""``dmrl check``: findings about recordings."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmrl.errors import SettingError
from dmrl.pipeline import batch
from dmrl.pipeline.executor import Executor, open_executor
from dmrl.pipeline.job import JobResult, has_failed
from dmrl.terminal.arguments import AsJson, In, On, Workers
from dmrl.terminal.tables import count_things, print_json, print_line

if TYPE_CHECKING:
    from dmrl.recording import Finding


@dataclass(frozen=True, slots=True)
class Checked:
    """Size of a recording, the findings of its checks, and the encodings it did not decode."""

    messages: int
    topics: int
    findings: "list[Finding]"
    undecoded: dict[str, str]


def run(recording: Path) -> Checked:
    """Check a recording.

    Raises
    ------
    RecordingError
        If it is not a complete recording.
    """
    from dmrl.recording import check, read_summary
    from dmrl.recording.checks.scan import is_decoded

    findings, held = check(recording), read_summary(recording)
    undecoded = {
        topic: info.encoding
        for topic, info in held.topics.items()
        if info.count and not is_decoded(topic, info)
    }
    return Checked(held.count, len(held.topics), findings, undecoded)


def command(
    *recordings: In, workers: Workers = None, on: On = None, as_json: AsJson = False
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
    if len(recordings) > 1 or batch.is_collection(recordings[0]) or on is not None:
        return _check_side_by_side(recordings, open_executor(on, workers), as_json=as_json)
    found = asdict(run(recordings[0]))
    if as_json:
        shown = {key: found[key] for key in ("findings", "undecoded")}
        print_json({"recording": recordings[0].name, **shown})
    else:
        for line in map(_describe_finding, found["findings"]):
            print_line(line)
        print_line(f"{recordings[0]}: {_describe_size(found)}")
    return 1 if _count(found, "error") else 0


def _check_side_by_side(named: Sequence[Path], crew: Executor, *, as_json: bool) -> int:
    """Check recordings side by side; return 1 if one has an error or cannot be read."""
    found = {path: path for path in batch.find_all_recordings(named)}
    tasks = batch.build_tasks("check", "recording", found, None)
    with crew:
        done = list(batch.iter_results(tasks, crew, "Checking"))
    documents = sorted((_document(task, answer) for task, answer in done), key=_badness)
    for one in documents:
        if not as_json and "error" not in one:
            worst = "".join(f"; {_describe_finding(finding)}" for finding in one["findings"][:1])
            print_line(f"{one['recording']}: {_describe_size(one)}{worst}")
    errors, warnings = (sum(_count(d, level) for d in documents) for level in ("error", "warning"))
    sound = sum(not (_count(one, "error") or "error" in one) for one in documents)
    if as_json:
        totals = {"sound": sound, "errors": errors, "warnings": warnings}
        print_json({"recordings": documents, **totals})
    else:
        totals_line = f"{sound} without errors; {_count_findings(errors, warnings)}"
        print_line(f"{count_things(len(documents), 'recording')}: {totals_line}")
    batch.report_failures(done)
    return 0 if sound == len(documents) else 1


def _count(document: dict[str, Any], level: str) -> int:
    """Count the findings of a level."""
    return sum(one["level"] == level for one in document["findings"])


def _badness(document: dict[str, Any]) -> tuple[int, int, str]:
    """Return the order of a recording: worst first, then by name."""
    errors = _count(document, "error") + 10**6 * ("error" in document)
    return -errors, -_count(document, "warning"), document["recording"]


def _describe_finding(finding: dict[str, Any]) -> str:
    from dmrl.recording import Finding

    return Finding(**finding).to_line()


def _count_findings(errors: int, warnings: int) -> str:
    return f"{count_things(errors, 'error')}, {count_things(warnings, 'warning')}"


def _describe_size(found: dict[str, Any]) -> str:
    """Return the size of a recording, its undecoded messages, and the number of its findings."""
    counts = _count_findings(_count(found, "error"), _count(found, "warning"))
    size = (
        f"{count_things(found['messages'], 'message')} on {count_things(found['topics'], 'topic')}"
    )
    if undecoded := found["undecoded"]:
        names = {"": "no encoding", "protobuf": "protobuf of other types"}
        kinds = ", ".join(sorted({names.get(one, one) for one in undecoded.values()}))
        size += f" ({count_things(len(undecoded), 'topic')} not decoded: {kinds})"
    return f"{size}, {counts}"


def _document(task: batch.Task, answer: JobResult) -> dict[str, Any]:
    named = {"recording": str(task.source)}
    if has_failed(answer):
        return {**named, "error": batch.error_text(task, answer), "findings": []}
    return {**named, **answer["result"]}
