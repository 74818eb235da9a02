"""Define a path to a file or folder in a bucket with the interface of `pathlib.Path`.

Listings, sizes and times come from the server. `RemotePath.open` reads by byte ranges. A library
that opens it by name (`os.fspath`) gets a local copy, which is kept until this process ends.
"""

import hashlib
import io
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path, PosixPath
from typing import Any

from dmrl.errors import StorageError
from dmrl.guards.paths import refuse_pipe
from dmrl.guards.safe_names import safe_join, truncate
from dmrl.storage.remote_stream import RangeReader
from dmrl.storage.system import get_filesystem, translate_errors

SCHEMES = ("s3", "gs", "gcs", "az", "abfs")
"""Schemes of a remote name, before ``://``."""
UNFINISHED_MARK = ".dmrl-unfinished"
"""Mark in a folder that is being written. A folder with it counts as missing."""
VERSION_MARK = "?versionId="
"""Text that s3fs interprets as the end of a key."""
HASH_METADATA_KEY = "dmrl-sha256"
"""Metadata key of an object that dmrl wrote, with its hash, so that no reader has to compute it."""


class RemotePath(PosixPath):
    """A path such as ``s3://bucket/key``. Paths relative to one are plain paths."""

    @property
    def scheme(self) -> str:
        """Scheme, such as "s3"; empty for a part of a path."""
        head = self.parts[0] if self.parts else ""
        return head[:-1] if head[:-1] in SCHEMES and head.endswith(":") else ""

    @property
    def key(self) -> str:
        """Name in the file system of its scheme."""
        return "/".join(self.parts[1:])

    @property
    def bucket(self) -> "RemotePath":
        """The bucket of this path."""
        return type(self)(*self.parts[:2])

    def __str__(self) -> str:
        plain = super().__str__()
        return plain.replace(":/", "://", 1) if self.scheme else plain

    def __fspath__(self) -> str:
        return _download(self) if self.scheme else super().__str__()

    def _info(self) -> dict[str, Any]:
        with translate_errors(str(self)):
            found: dict[str, Any] = get_filesystem(self.scheme).info(self.key)
            return found

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Return size and times. The inode is a hash of the server's version tag."""
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
        """Return whether the file, or a complete folder, exists."""
        return self.is_file() or self.is_dir()

    def is_file(self) -> bool:
        """Return whether the path is an object."""
        try:
            return bool(self._info()["type"] == "file")
        except FileNotFoundError:
            return False

    def is_dir(self) -> bool:
        """Return whether objects exist below the path, and the folder is complete."""
        try:
            is_directory = self._info()["type"] == "directory"
        except FileNotFoundError:
            return False
        return is_directory and not (self / UNFINISHED_MARK).is_file()

    def is_symlink(self) -> bool:
        """Return False: buckets have no links."""
        return False

    def samefile(self, other: Any) -> bool:
        """Return whether the other path has the same name."""
        return str(self) == str(other)

    def resolve(self, strict: bool = False) -> "RemotePath":
        """Return the path itself."""
        return self

    def absolute(self) -> "RemotePath":
        """Return the path itself."""
        return self

    def list_files(self) -> list["RemotePath"]:
        """Return every file below the path, by name.

        Raises
        ------
        StorageError
            If no path can express a key, or it has control characters. The path of ``a//b`` is
            that of ``a/b``, another object.
        """
        with translate_errors(str(self)):
            found = get_filesystem(self.scheme).find(self.key)
        head, paths = f"{self.scheme}://", []
        for name in sorted(found):
            key = name.removeprefix(head)
            if key.endswith("/"):
                continue  # web consoles create such an object for an empty folder
            path = type(self)(head + key)
            is_below = path == self or self in path.parents
            if path.key != key or VERSION_MARK in key or not key.isprintable() or not is_below:
                raise StorageError(
                    f"{self}: an object is called {truncate(key)!r}, which cannot be a path. "
                    "Rename it, or name the files"
                )
            paths.append(path)
        return paths

    def iterdir(self) -> Iterator["RemotePath"]:  # type: ignore[override]
        """Yield the files and folders in the folder."""
        depth = len(self.parts) + 1
        yield from dict.fromkeys(type(self)(*one.parts[:depth]) for one in self.list_files())

    def glob(self, pattern: str, **_: Any) -> Iterator["RemotePath"]:  # type: ignore[override]
        """Yield the files below whose names match, part by part. ``**`` is not supported."""
        wanted = pattern.split("/")
        for one in self.list_files():
            parts = one.parts[len(self.parts) :]
            if len(parts) == len(wanted) and all(map(fnmatchcase, parts, wanted)):
                yield one

    def rglob(self, pattern: str, **_: Any) -> Iterator["RemotePath"]:  # type: ignore[override]
        """Yield the files below whose last part matches."""
        return (one for one in self.list_files() if fnmatchcase(one.name, pattern))

    def open(self, mode: str = "r", *_: Any, encoding: str | None = None, **more: Any) -> Any:
        """Open a stream that reads by byte ranges. Writing is not supported."""
        if set(mode) - set("rbt"):
            raise io.UnsupportedOperation(f"{self} can only be opened for reading")
        stream = io.BufferedReader(self.open_ranges())
        if "b" in mode:
            return stream
        return io.TextIOWrapper(stream, encoding or "utf-8", more.get("errors"))

    def open_ranges(self) -> RangeReader:
        """Return a reader of byte ranges of the file."""
        return RangeReader(get_filesystem(self.scheme), self.key, str(self), self._info())

    def sha256(self) -> str:
        """Return the hash from the object's metadata, or compute it from all its bytes."""
        if self.scheme == "s3":
            with translate_errors(str(self)):
                metadata = get_filesystem("s3").metadata(self.key, refresh=True)
            stored_hash = metadata.get(HASH_METADATA_KEY) or metadata.get(
                HASH_METADATA_KEY.replace("-", "_")
            )
            if stored_hash and len(stored_hash) == 64:
                return str(stored_hash)
        digest = hashlib.sha256()
        for block in self.open_ranges().iter_blocks():
            digest.update(block)
        return digest.hexdigest()

    def mkdir(self, *_: Any, **__: Any) -> None:
        """Ignore the call: folders of buckets exist once they contain a file."""

    def rmdir(self) -> None:
        """Ignore the call, as `mkdir` does."""

    def unlink(self, missing_ok: bool = False) -> None:
        """Remove the file."""
        try:
            with translate_errors(str(self)):
                get_filesystem(self.scheme).rm_file(self.key)
        except FileNotFoundError:
            if not missing_ok:
                raise

    def remove_tree(self) -> None:
        """Remove the file, or everything below."""
        with translate_errors(str(self)):
            if get_filesystem(self.scheme).exists(self.key):
                get_filesystem(self.scheme).rm(self.key, recursive=True)

    def replace(self, target: Any) -> Any:
        """Rename within the same store; the server copies the objects."""
        files = [self] if self.is_file() else self.list_files()
        if not files:
            raise FileNotFoundError(2, "No such file", str(self))
        target.remove_tree()
        marks = [] if files == [self] else [target / UNFINISHED_MARK]
        with translate_errors(str(self)):
            for mark in marks:
                get_filesystem(self.scheme).pipe_file(mark.key, b"")
            for one in files:
                to = target.joinpath(*one.parts[len(self.parts) :])
                get_filesystem(self.scheme).cp_file(one.key, to.key)
                if to.stat().st_size != one.stat().st_size:
                    raise StorageError(f"{to}: the server did not copy {one}. Run it again")
        for mark in marks:
            mark.unlink()
        self.remove_tree()
        return target

    rename = replace


def to_path(name: str | os.PathLike[str]) -> Path:
    """Return a `RemotePath` for a name such as ``s3://bucket/key``, else a plain path.

    A path is returned unchanged.

    Raises
    ------
    UnsafeName
        If it names a pipe or a device, where a read could block or never end.
    StorageError
        If it is the address of a file on a web server.
    """
    if isinstance(name, Path):
        return name
    name = os.fspath(name)
    scheme, mark, _ = name.partition("://")
    if mark and scheme in SCHEMES:
        return RemotePath(name)
    if mark and scheme in ("http", "https"):
        raise StorageError(f"{name} is on a web server. Copy the file first: curl -O {name}")
    refuse_pipe(Path(name))
    return Path(name)


@cache
def _make_cache_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="dmrl-remote-")


def _download(path: RemotePath) -> str:
    """Download a file, or a folder with all its files, and return the local path."""
    info = path._info()
    version = f"{path} {info.get('ETag')} {info.get('size')}"
    place = Path(_make_cache_folder().name) / hashlib.sha256(version.encode()).hexdigest()[:16]
    place = safe_join(place, path.name, f"{path}: its name")
    is_file = info["type"] == "file"
    if is_file and place.exists():
        return str(place)
    for one in [path] if is_file else path.list_files():
        to = place
        for part in () if is_file else one.parts[len(path.parts) :]:
            to = safe_join(to, part, f"{path}: a file")
        to.parent.mkdir(parents=True, exist_ok=True)
        stream, free = one.open_ranges(), shutil.disk_usage(to.parent).free
        if stream.size > free:
            raise StorageError(
                f"{one} has {stream.size} bytes, but only {free} are free. Free some"
            )
        with to.open("wb") as out:
            out.writelines(stream.iter_blocks())
    return str(place)
