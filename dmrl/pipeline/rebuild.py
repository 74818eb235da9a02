"""Make a recording again from its own provenance, and compare the two.

An input is taken from the folder of the recording, or another that is named, if it has the hash
that the provenance states. One that dmrl wrote and that is absent is made again first.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any

from dmrl.errors import DmrlError, RecordingError
from dmrl.guards.safe_names import safe_join
from dmrl.learn.pretrained import resolve_model_path
from dmrl.pipeline.job import build_job
from dmrl.pipeline.job_worker import run_job
from dmrl.pipeline.plan import map_strings
from dmrl.pipeline.recipe_language import iter_leaves
from dmrl.pipeline.stage_signature import StageSignature, signature_of
from dmrl.recording import Provenance, read_raw, read_summary
from dmrl.recording.provenance import Input
from dmrl.recording.provenance_inputs import hash_file, hash_folder
from dmrl.terminal.progress import say

DERIVED = {"model_threshold", "start_ns", "end_ns"}
"""Settings of a provenance that its stage computed."""
LIVE = "record"
"""Stage whose input was the world."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference of two recordings.

    Parameters
    ----------
    what
        A topic, or a package whose version may be the reason.
    before, after
        Number of messages, or version, of the two.
    """

    what: str
    before: str
    after: str


def rebuild(source: Path, out: Path, data: Path | None = None) -> list[Difference]:
    """Make a recording again; return the differences, none where all messages are equal.

    Parameters
    ----------
    source
        Recording that dmrl wrote.
    out
        Recording to write.
    data
        Another folder with inputs.

    Raises
    ------
    RecordingError
        If the recording has no provenance, or an input is neither there nor can be made again.
    DmrlError
        If a stage fails.
    """
    made = read_summary(source).provenance
    if made is None:
        raise RecordingError(f"{source} has no provenance. Name a recording that dmrl wrote")
    folders = [source.absolute().parent, *([data] if data else [])]
    with TemporaryDirectory() as scratch:
        _make(made, out, source, folders, Path(scratch))
    return list(_iter_differences(source, out, made))


def _make(made: Provenance, out: Path, source: Path, folders: list[Path], scratch: Path) -> None:
    """Run the stage of a provenance, after those of inputs that are absent."""
    if made.stage == LIVE:
        raise RecordingError(f"{source} comes from a live flight, which cannot be made again")
    takes = signature_of(made.stage)
    paths = [(one.name, _provide(one, source, folders, scratch)) for one in made.inputs]
    named = dict(reversed(paths))
    settings = {k: v for k, v in made.settings.items() if k not in DERIVED}
    if unknown := settings.keys() - set(takes.keys):
        raise RecordingError(
            f"{source}: this version's {made.stage} has no setting {sorted(unknown)[0]}. "
            f"Use dmrl {made.dmrl_version}"
        )
    for key in takes.paths & settings.keys():
        settings[key] = map_strings(settings[key], lambda name: str(named.get(name, name)))
        taken = set(iter_leaves(made.settings[key], str))
        paths = [(name, path) for name, path in paths if name not in taken]
    say(f"{made.stage} {' '.join(name for name, _ in paths)}".rstrip())
    inputs = _assign_inputs(takes, [path for _, path in paths])
    answer = run_job(build_job(made.stage, out, inputs, settings))
    if fault := answer.get("error") or answer.get("bug"):
        raise DmrlError(str(fault))


def _assign_inputs(takes: StageSignature, paths: list[Path]) -> dict[str, Any]:
    """Give inputs to the arguments of a stage, in their order."""
    left, inputs = list(paths), dict[str, Any]()
    for name, role in takes.roles.items():
        if role.many:
            inputs[name], left = left, []
        elif left:
            inputs[name] = left.pop(0)
    return inputs


def _provide(wanted: Input, source: Path, folders: list[Path], scratch: Path) -> Path:
    """Return the path of an input, which is made again if it is absent."""
    what = f"{source}: an input"
    for folder in folders:
        if _has_hash(path := safe_join(folder, wanted.name, what), wanted.sha256):
            return path
    if _has_hash(path := resolve_model_path(Path(wanted.name)), wanted.sha256):
        return path
    if wanted.provenance is None:
        raise RecordingError(
            f"{source}: no {wanted.name} of SHA-256 {wanted.sha256[:12]} in "
            f"{', '.join(map(str, folders))}. Name its folder: --data DIR"
        )
    path = safe_join(Path(mkdtemp(dir=scratch)), wanted.name, what)
    _make(wanted.provenance, path, source, folders, scratch)
    if not _has_hash(path, wanted.sha256):
        say(f"{wanted.name}: made again, and other bytes than before")
    folders.append(path.parent)  # another stage may read it
    return path


def _has_hash(path: Path, sha256: str) -> bool:
    """Return whether a file, a folder or a file in it has this hash."""
    if path.is_file():
        return hash_file(path) == sha256
    # The provenance of predictions has the hash of the weights alone.
    return path.is_dir() and (
        hash_folder(path) == sha256
        or any(hash_file(file) == sha256 for file in path.iterdir() if file.is_file())
    )


def _iter_differences(source: Path, out: Path, made: Provenance) -> Iterator[Difference]:
    """Yield topics with other messages, and then versions that may be the reason."""
    before, after = _digest_topics(source), _digest_topics(out)
    topics = [t for t in sorted(before | after) if before.get(t) != after.get(t)]
    for topic in topics:
        counts = (str(of.get(topic, (0, ""))[0]) for of in (before, after))
        yield Difference(topic, *counts)
    now = read_summary(out).provenance
    if topics and now is not None:
        versions = [{"dmrl": of.dmrl_version, **of.libraries} for of in (made, now)]
        for name in sorted(versions[0] | versions[1]):
            was, is_now = (of.get(name, "absent") for of in versions)
            if was != is_now:
                yield Difference(name, was, is_now)


def _digest_topics(path: Path) -> dict[str, tuple[int, str]]:
    """Return number and hash of the messages of each topic, with their times."""
    digests, counts = dict[str, Any](), dict[str, int]()
    for raw in read_raw(path):
        digest = digests.setdefault(raw.topic, hashlib.sha256())
        digest.update(f"{raw.time_ns} {raw.publish_ns} {len(raw.data)} ".encode() + raw.data)
        counts[raw.topic] = counts.get(raw.topic, 0) + 1
    return {topic: (counts[topic], digest.hexdigest()) for topic, digest in digests.items()}
