"""A path to a file or folder in a bucket, which answers as one of this machine's does.

Listings, sizes and times come from the server. Opened with `Remote.open` it is read by ranges. A
library that opens it by its name (`os.fspath`) gets a copy, kept as long as this process.
"""

import hashlib
import io
import os
import stat
import tempfile
from collections.abc import Iterator
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path, PosixPath
from typing import Any

from dmrl.errors import StorageError
from dmrl.guards.paths import refuse_pipe
from dmrl.guards.safe_names import inside
from dmrl.storage.remote_stream import STEP_BYTES, Ranged
from dmrl.storage.system import system, told

SCHEMES = ("s3", "gs", "gcs", "az", "abfs", "http", "https")
"""What a name begins with, before ``://``."""
UNFINISHED = ".dmrl-unfinished"
"""Stands in a folder while it is written: what has it is not whole, and not there."""
VERSION = "?versionId="
"""What s3fs takes for an end of the key."""
METADATA = "dmrl-sha256"
"""Of an object that dmrl wrote: its hash, so that nobody has to read it for that."""


class Remote(PosixPath):
    """A path such as ``s3://bucket/key``; what is relative to one is plain again."""

    @property
    def scheme(self) -> str:
        """What it begins with, such as "s3"; empty: it is part of a path."""
        head = self.parts[0] if self.parts else ""
        return head[:-1] if head[:-1] in SCHEMES and head.endswith(":") else ""

    @property
    def key(self) -> str:
        """Its name in the file system of its scheme."""
        rest = "/".join(self.parts[1:])
        return f"{self.scheme}://{rest}" if self.scheme.startswith("http") else rest

    @property
    def bucket(self) -> "Remote":
        """The bucket that it lies in."""
        return type(self)(*self.parts[:2])

    def __str__(self) -> str:
        plain = super().__str__()
        return plain.replace(":/", "://", 1) if self.scheme else plain

    def __fspath__(self) -> str:
        return _copy(self) if self.scheme else super().__str__()

    def _info(self) -> dict[str, Any]:
        with told(str(self)):
            found: dict[str, Any] = system(self.scheme).info(self.key)
            return found

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Size and times; its inode is a hash of what the server calls this version of it."""
        info = self._info()
        kind = stat.S_IFDIR if info["type"] == "directory" else stat.S_IFREG
        when = info.get("LastModified") or info.get("updated") or info.get("mtime") or 0
        when_s = when.timestamp() if hasattr(when, "timestamp") else 0.0
        tag = str(info.get("ETag") or info.get("etag") or info.get("size"))
        inode = int.from_bytes(hashlib.sha256(tag.encode()).digest()[:7], "big")
        size, when_ns = int(info.get("size") or 0), round(when_s * 1e9)
        times = {"st_mtime_ns": when_ns, "st_ctime_ns": when_ns + inode % 1000}
        whole_s = int(when_s)
        return os.stat_result(
            (kind | 0o644, inode, 0, 1, 0, 0, size, whole_s, whole_s, whole_s), times
        )

    def exists(self, **_: Any) -> bool:
        """Whether it is there, and whole."""
        return self.is_file() or self.is_dir()

    def is_file(self) -> bool:
        """Whether it is an object."""
        try:
            return bool(self._info()["type"] == "file")
        except FileNotFoundError:
            return False

    def is_dir(self) -> bool:
        """Whether there is something below it, and it is whole."""
        try:
            there = self._info()["type"] == "directory"
        except FileNotFoundError:
            return False
        return there and not (self / UNFINISHED).is_file()

    def is_symlink(self) -> bool:
        """Buckets have no links."""
        return False

    def samefile(self, other: Any) -> bool:
        """Whether it has the same name."""
        return str(self) == str(other)

    def resolve(self, strict: bool = False) -> "Remote":
        """Itself."""
        return self

    def absolute(self) -> "Remote":
        """Itself."""
        return self

    def below(self) -> list["Remote"]:
        """Every file below it, by name.

        Raises
        ------
        StorageError
            If there is one whose key no path stands for: of ``a//b`` the path is that of ``a/b``,
            which is another.
        """
        with told(str(self)):
            found = system(self.scheme).find(self.key)
        head, paths = f"{self.scheme}://", []
        for name in sorted(found):
            key = name.removeprefix(head)
            if key.endswith("/"):
                continue  # consoles make such an object for an empty folder
            path = type(self)(head + key)
            if path.key != key or VERSION in key:
                raise StorageError(
                    f"{self}: an object is called {key!r}, which can be no path. Rename it, or "
                    "name the files"
                )
            paths.append(path)
        return paths

    def iterdir(self) -> Iterator["Remote"]:  # type: ignore[override]
        """Files and folders in it."""
        depth = len(self.parts) + 1
        yield from dict.fromkeys(type(self)(*one.parts[:depth]) for one in self.below())

    def glob(self, pattern: str, **_: Any) -> Iterator["Remote"]:  # type: ignore[override]
        """Files below it whose names match, part by part; ``**`` is not known."""
        wanted = pattern.split("/")
        for one in self.below():
            parts = one.parts[len(self.parts) :]
            if len(parts) == len(wanted) and all(map(fnmatchcase, parts, wanted)):
                yield one

    def rglob(self, pattern: str, **_: Any) -> Iterator["Remote"]:  # type: ignore[override]
        """Files below it whose last part matches."""
        return (one for one in self.below() if fnmatchcase(one.name, pattern))

    def open(self, mode: str = "r", *_: Any, encoding: str | None = None, **more: Any) -> Any:
        """A stream that reads by ranges; it cannot be written."""
        if set(mode) - set("rbt"):
            raise io.UnsupportedOperation(f"{self} is written whole or not at all")
        stream = io.BufferedReader(self.ranged())
        if "b" in mode:
            return stream
        return io.TextIOWrapper(stream, encoding or "utf-8", more.get("errors"))

    def ranged(self) -> Ranged:
        """The file, to be read by ranges."""
        info = self._info()
        return Ranged(system(self.scheme), self.key, str(self), int(info.get("size") or 0))

    def sha256(self) -> str:
        """Of its bytes, as whoever wrote it said, or else all read."""
        if self.scheme == "s3":
            with told(str(self)):
                said = system("s3").metadata(self.key, refresh=True)
            known = said.get(METADATA) or said.get(METADATA.replace("-", "_"))
            if known and len(known) == 64:
                return str(known)
        digest, stream, at = hashlib.sha256(), self.ranged(), 0
        while data := stream.fetch(at, STEP_BYTES):
            digest.update(data)
            at += len(data)
        return digest.hexdigest()

    def mkdir(self, *_: Any, **__: Any) -> None:
        """Nothing: folders of buckets are there once something is in them."""

    def rmdir(self) -> None:
        """Nothing, for the same reason."""

    def unlink(self, missing_ok: bool = False) -> None:
        """Remove the file."""
        try:
            with told(str(self)):
                system(self.scheme).rm_file(self.key)
        except FileNotFoundError:
            if not missing_ok:
                raise

    def remove_all(self) -> None:
        """Remove the file, or everything below."""
        with told(str(self)):
            if system(self.scheme).exists(self.key):
                system(self.scheme).rm(self.key, recursive=True)

    def replace(self, target: Any) -> Any:
        """Give it another name in the same store; the server copies it."""
        files = [self] if self.is_file() else self.below()
        if not files:
            raise FileNotFoundError(2, "No such file", str(self))
        target.remove_all()
        marks = [] if files == [self] else [target / UNFINISHED]
        with told(str(self)):
            for mark in marks:
                system(self.scheme).pipe_file(mark.key, b"")
            for one in files:
                to = target.joinpath(*one.parts[len(self.parts) :])
                system(self.scheme).cp_file(one.key, to.key)
        for mark in marks:
            mark.unlink()
        self.remove_all()
        return target

    rename = replace


def path_of(name: str) -> Path:
    """The path that a name stands for: of ``s3://bucket/key`` a `Remote`, else a plain one.

    Raises
    ------
    UnsafeName
        If it is that of a pipe or a device: who opens one waits for ever, or reads without end.
    """
    scheme, mark, _ = name.partition("://")
    if mark and scheme in SCHEMES:
        return Remote(name)
    refuse_pipe(Path(name))
    return Path(name)


@cache
def _kept() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="dmrl-remote-")


def _copy(path: Remote) -> str:
    """Where a copy of a file, or of a folder with all in it, lies on this machine."""
    info = path._info()
    version = f"{path} {info.get('ETag')} {info.get('size')}"
    place = Path(_kept().name) / hashlib.sha256(version.encode()).hexdigest()[:16]
    place = inside(place, path.name, f"{path}: its name")
    is_file = info["type"] == "file"
    if is_file and place.exists():
        return str(place)
    for one in [path] if is_file else path.below():
        to = place
        for part in () if is_file else one.parts[len(path.parts) :]:
            to = inside(to, part, f"{path}: a file")
        to.parent.mkdir(parents=True, exist_ok=True)
        with told(str(one)):
            system(path.scheme).get_file(one.key, str(to))
    return str(place)
