"""Build the provenance of an output: hash its inputs and nest their provenance."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dmrl.errors import RecordingError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.guards.paths import refuse_pipe
from dmrl.recording.mcap.file import expect_unchanged
from dmrl.recording.provenance import FILE_NAME, Input, Provenance
from dmrl.recording.summary import read_summary
from dmrl.storage import RemotePath, shared_file

UNHASHED_NAMES = ("README.md", "figures", "tensorboard")
"""Files and folders that the hash of an output folder leaves out."""


def refuse_duplicates(paths: Sequence[Path]) -> None:
    """Raise RecordingError if a recording is named twice."""
    if len({path.resolve() for path in paths}) != len(paths):
        raise RecordingError(f"{paths[0]}: a recording is given twice. Name each once")


def build_provenance(
    stage: str,
    settings: Any = None,
    inputs: Sequence[Path] = (),
    *,
    seed: int | None = None,
    libraries: Sequence[str] = (),
) -> Provenance:
    """Build the provenance of an output, and hash its inputs.

    Parameters
    ----------
    stage
        Name of the command.
    settings
        A settings dataclass, a dictionary, or None.
    inputs
        Files and folders that the stage reads.
    seed
        Random seed.
    libraries
        Names of installed packages whose version can change the result.

    Raises
    ------
    RecordingError
        If an input does not exist.
    """
    values = settings if isinstance(settings, dict) else asdict(settings) if settings else {}
    return Provenance(
        stage=stage,
        settings=json.loads(json.dumps(values, default=_to_json_value)),
        seed=seed,
        inputs=tuple(build_input(path) for path in inputs),
        libraries={name: _find_version(name) for name in libraries},
    )


def _to_json_value(value: object) -> str:
    # Only the name of a path: outputs do not depend on the location of files.
    return value.name if isinstance(value, Path) else str(value)


def _find_version(package: str) -> str:
    from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 - as in plugins

    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


def build_input(path: Path) -> Input:
    """Return name, hash and provenance of a file or folder.

    Raises
    ------
    RecordingError
        If there is no such file or folder.
    UnsafeName
        If it is a pipe or a device, which cannot be read to an end.
    """
    if not path.exists():
        raise RecordingError(f"no file or folder {path}. Check the name")
    refuse_pipe(path)  # a link in a folder may point to a device
    with shared_file.share_file(path):
        if path.suffix == ".mcap" and path.is_file():
            expect_unchanged(path)
        digest = hash_folder(path) if path.is_dir() else hash_file(path)
        return Input(path.resolve().name, digest, read_provenance(path))


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    if isinstance(path, RemotePath):
        return path.sha256()
    return shared_file.hash_file(path)


def hash_folder(folder: Path) -> str:
    """Return the SHA-256 of the sorted relative names and contents of a folder's files.

    In a folder that dmrl wrote, the card, which may be rewritten, and the training log, which
    contains times, are left out.
    """
    left_out = UNHASHED_NAMES if (folder / FILE_NAME).is_file() else ()
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        if path.relative_to(folder).parts[0] in left_out:
            continue
        digest.update(f"{path.relative_to(folder).as_posix()}\0{hash_file(path)}\n".encode())
    return digest.hexdigest()


def read_provenance(path: Path) -> Provenance | None:
    """Read the provenance of a recording or output folder; return None if it has none.

    Raises
    ------
    RecordingError
        If the provenance is corrupt.
    """
    if path.suffix == ".mcap" and path.is_file():
        return read_summary(path).provenance
    file = path / FILE_NAME
    if not file.is_file():
        return None
    try:
        return Provenance.from_json(parse_json(file.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError) as e:
        raise RecordingError(f"{file} is damaged: {e}. Make {path} again") from e
