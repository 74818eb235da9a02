"""Write outputs locally and upload them when they are complete.

A file is uploaded by one request, or by a multipart upload that is completed at its end. A folder
contains a mark until its last file is uploaded.
"""

import hashlib
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from dmrl.errors import StorageError
from dmrl.guards.safe_names import safe_join
from dmrl.storage.remote import HASH_METADATA_KEY, UNFINISHED_MARK, RemotePath
from dmrl.storage.system import get_filesystem, translate_errors


def require_bucket(path: RemotePath) -> None:
    """Raise StorageError unless the bucket of a path exists and can be written."""
    with translate_errors(str(path)):
        exists = get_filesystem(path.scheme).exists(path.bucket.key)
    if not exists:
        raise StorageError(f"{path}: there is no such bucket. Check the name")


@contextmanager
def upload_file(path: RemotePath) -> Iterator[Path]:
    """Yield a local path to write to, and upload the file if the block ends without an error.

    Raises
    ------
    StorageError
        If the server cannot be reached, or refuses.
    """
    with _make_local(path) as local:
        yield local
        _upload(local, path)


@contextmanager
def _make_local(path: RemotePath) -> Iterator[Path]:
    """Yield a local path of the same name, which is removed after the block."""
    with tempfile.TemporaryDirectory(prefix="dmrl-") as folder:
        yield safe_join(Path(folder), path.name, f"{path}: its name")


@contextmanager
def upload_folder(path: RemotePath) -> Iterator[Path]:
    """Yield a local folder to write in; upload it if the block ends without an error.

    Files that a killed process had uploaded are removed first.

    Raises
    ------
    StorageError
        If the server cannot be reached, or refuses. Uploaded files are then removed.
    """
    with _make_local(path) as local:
        local.mkdir()
        yield local
        mark = path / UNFINISHED_MARK
        with translate_errors(str(path)):
            path.remove_tree()
            get_filesystem(path.scheme).pipe_file(mark.key, b"")
        try:
            for file in sorted(one for one in local.rglob("*") if one.is_file()):
                _upload(file, path / file.relative_to(local).as_posix())
        except BaseException:
            with suppress(StorageError, OSError):
                path.remove_tree()
            raise
        mark.unlink()


@contextmanager
def upload_into_folder(path: RemotePath, last: str) -> Iterator[Path]:
    """Yield a local folder, and upload its files into an existing one, ``last`` as the last.

    Raises
    ------
    StorageError
        If the server cannot be reached, or refuses.
    """
    with _make_local(path) as local:
        local.mkdir()
        yield local
        files = [one.relative_to(local) for one in local.rglob("*") if one.is_file()]
        for file in sorted(files, key=lambda one: (one == Path(last), one)):
            _upload(local / file, path / file.as_posix())


def _upload(local: Path, path: RemotePath) -> None:
    with local.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    more: dict[str, Any] = {"Metadata": {HASH_METADATA_KEY: digest}} if path.scheme == "s3" else {}
    with translate_errors(str(path)):
        get_filesystem(path.scheme).put_file(str(local), path.key, **more)
