"""What a pipeline's folder remembers: what every output was made from, and hashes of files.

One JSON file. A file is hashed again when its size or one of its times has changed.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dmrl import __version__
from dmrl.atomic_output import rewritten_file
from dmrl.errors import OutputError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.recording.provenance_inputs import sha256_of_file, sha256_of_folder
from dmrl.storage import Remote


@dataclass(slots=True)
class Memory:
    """What is known of outputs and files.

    Parameters
    ----------
    file
        Where it is kept.
    begun
        Key of what was begun last, by output.
    done
        Key and SHA-256 of what was made, by output.
    hashes
        Size and times of a file, and its SHA-256, by path; of a folder's files together.
    """

    file: Path
    begun: dict[str, str] = field(default_factory=dict)
    done: dict[str, list[str]] = field(default_factory=dict)
    hashes: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def of(cls, file: Path) -> "Memory":
        """What a file holds; nothing, if there is none.

        Raises
        ------
        OutputError
            If the file is damaged.
        """
        try:
            kept = parse_json(file.read_text(encoding="utf-8"))
            return cls(file, dict(kept["begun"]), dict(kept["done"]), dict(kept["hashes"]))
        except FileNotFoundError:
            return cls(file)
        except (ValueError, KeyError, TypeError, OSError) as e:
            raise OutputError(
                f"{file} is damaged ({e}). Remove {file.parent}, or name another: --out DIR"
            ) from None

    def save(self) -> None:
        """Write it, whole or not at all."""
        kept = {key: value for key, value in asdict(self).items() if key != "file"}
        with rewritten_file(self.file) as partial:
            partial.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")

    def sha256(self, path: Path) -> str:
        """SHA-256 of a file, or of a folder's names and contents.

        Raises
        ------
        OSError
            If it is not there, or cannot be read.
        """
        looks = _looks(path)
        known = self.hashes.get(str(path))
        if known is None or known[0] != looks:
            digest = sha256_of_folder(path) if path.is_dir() else sha256_of_file(path)
            self.hashes[str(path)] = known = [looks, digest]
        return known[1]

    def know(self, path: Path, sha256: str) -> None:
        """Note the hash of a file or folder as it is now."""
        self.hashes[str(path)] = [_looks(path), sha256]

    def is_made(self, out: Path, key: str) -> bool:
        """Whether an output was made with this key, and is as it was made."""
        known = self.done.get(out.name)
        if known is None or known[0] != key or not out.exists():
            return False
        return self.sha256(out) == known[1]

    def forget_what_is_gone(self) -> None:
        """Drop the hashes of files that are no more."""
        self.hashes = {path: known for path, known in self.hashes.items() if Path(path).exists()}


def key_of(stage: str, settings: Mapping[str, Any], inputs: Mapping[str, Any]) -> str:
    """What decides the bytes of an output, as one hash.

    Parameters
    ----------
    stage
        Command name.
    settings
        All that matter, as values of JSON.
    inputs
        Name and SHA-256 of every input, by role.
    """
    made_of = {"dmrl": __version__, "stage": stage, "settings": settings, "inputs": inputs}
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


def _looks(path: Path) -> str:
    """Sizes and times of a file, or of all files of a folder."""
    if not path.is_dir():
        return _look(path.stat())
    digest = hashlib.sha256()
    for name, found in sorted(_files(path)):
        digest.update(f"{name}\0{_look(found)}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _files(folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    if isinstance(folder, Remote):
        for one in folder.below():
            yield str(one.relative_to(folder)), one.stat()
        return
    for where, _, names in os.walk(folder):
        for name in names:
            path = Path(where, name)
            if path.is_file():  # no link to nowhere, as what hashes a folder
                yield str(path.relative_to(folder)), path.stat()


def _look(found: os.stat_result) -> str:
    return f"{found.st_size} {found.st_mtime_ns} {found.st_ctime_ns}"
