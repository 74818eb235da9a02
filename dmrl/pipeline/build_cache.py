"""Build cache of a pipeline's folder: keys of outputs, and hashes of files.

One JSON file. A file is hashed again when its size or one of its times has changed.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dmrl.atomic_output import replace_file
from dmrl.errors import OutputError
from dmrl.guards.bounded_parsing import parse_json
from dmrl.recording.provenance_inputs import hash_file, hash_folder
from dmrl.storage import RemotePath


@dataclass(slots=True)
class BuildCache:
    """Keys of outputs, and hashes of files.

    Parameters
    ----------
    file
        JSON file of the cache.
    begun
        Key of the last build that began, by output.
    done
        Key and SHA-256 of the last build that ended, by output.
    hashes
        Size and times of a file, and its SHA-256, by path; of a folder's files together.
    made_of
        Stage, settings and inputs of the last build that ended, by output.
    """

    file: Path
    begun: dict[str, str] = field(default_factory=dict)
    done: dict[str, list[str]] = field(default_factory=dict)
    hashes: dict[str, list[str]] = field(default_factory=dict)
    made_of: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def load(cls, file: Path) -> "BuildCache":
        """Load a cache; an empty one, if there is no file.

        Raises
        ------
        OutputError
            If the file is damaged.
        """
        try:
            kept = parse_json(file.read_text(encoding="utf-8"))
            made_of = dict(kept.get("made_of", {}))
            return cls(file, dict(kept["begun"]), dict(kept["done"]), dict(kept["hashes"]), made_of)
        except FileNotFoundError:
            return cls(file)
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as e:
            raise OutputError(
                f"{file} is damaged ({e}). Remove {file.parent}, or name another: --out DIR"
            ) from None

    def save(self) -> None:
        """Write the cache, atomically."""
        kept = {key: value for key, value in asdict(self).items() if key != "file"}
        with replace_file(self.file) as partial:
            partial.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")

    def get_sha256(self, path: Path) -> str:
        """Return the SHA-256 of a file, or of a folder's names and contents.

        Raises
        ------
        OSError
            If the path is missing, or cannot be read.
        """
        looks = _fingerprint(path)
        known = self.hashes.get(str(path))
        if known is None or known[0] != looks:
            digest = hash_folder(path) if path.is_dir() else hash_file(path)
            self.hashes[str(path)] = known = [looks, digest]
        return known[1]

    def set_sha256(self, path: Path, sha256: str) -> None:
        """Set the hash of a file or folder as it is now."""
        self.hashes[str(path)] = [_fingerprint(path), sha256]

    def is_up_to_date(self, out: Path, key: str) -> bool:
        """Return whether an output was built with this key, and is unchanged."""
        known = self.done.get(out.name)
        if known is None or known[0] != key or not out.exists():
            return False
        return self.get_sha256(out) == known[1]

    def drop_missing_files(self) -> None:
        """Remove the hashes of missing files."""
        self.hashes = {path: known for path, known in self.hashes.items() if Path(path).exists()}


def build_key(made_of: Mapping[str, Any]) -> str:
    """Return one hash of the description of a build."""
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


def _fingerprint(path: Path) -> str:
    """Return the sizes and times of a file, or of all files of a folder, as text."""
    if not path.is_dir():
        return _stat_text(path.stat())
    digest = hashlib.sha256()
    for name, found in sorted(_iter_files(path)):
        digest.update(f"{name}\0{_stat_text(found)}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _iter_files(folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    if isinstance(folder, RemotePath):
        for one in folder.list_files():
            yield str(one.relative_to(folder)), one.stat()
        return
    for where, _, names in os.walk(folder):
        for name in names:
            path = Path(where, name)
            if path.is_file():  # no broken link, as in the hash of a folder
                yield str(path.relative_to(folder)), path.stat()


def _stat_text(found: os.stat_result) -> str:
    return f"{found.st_size} {found.st_mtime_ns} {found.st_ctime_ns}"
