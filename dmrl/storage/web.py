"""Read files from web servers, which are not trusted: only requested bytes are accepted.

fsspec reads the whole answer of a server into memory. Here an answer is read up to the
requested size, and must be that range of the same version of the file.
"""

import re
import shutil
from pathlib import Path
from typing import Any

from aiohttp import ClientTimeout
from fsspec.implementations.http import HTTPFileSystem

from dmrl.errors import StorageError

COPY_STEP_BYTES = 1 << 20
"""Bytes that are read at a time when a file is copied."""
PATIENCE_S, SLOWEST_BPS = 30.0, 50_000
"""Timeout of an answer: a fixed part, seconds, and a minimum rate, bytes per second."""
HTTP_PARTIAL_CONTENT = 206
CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/(?:\d+|\*)")
VERSION_HEADERS = ("ETag", "Last-Modified")
"""Headers that identify the version of a file."""


class WebFileSystem(HTTPFileSystem):  # type: ignore[misc]
    """File system of web servers, for `dmrl.storage.system`."""

    protocol = ("http", "https")

    def __init__(self, **given: Any) -> None:
        # A compressed answer could decompress to any size.
        client_options = {"auto_decompress": False, "timeout": _build_timeout(0)}
        super().__init__(client_kwargs=client_options, **given)
        self._versions: dict[str, dict[str, str]] = {}

    async def _info(self, url: str, **given: Any) -> dict[str, Any]:
        """Return size and version. Later reads must be of this version."""
        info: dict[str, Any] = await super()._info(url, **given)
        if info["size"] is None:
            raise StorageError(f"{url}: the server does not report its size. Copy the file")
        self._versions[url] = {name: info[name] for name in VERSION_HEADERS if info.get(name)}
        return info

    async def _cat_file(
        self, url: str, start: int | None = None, end: int | None = None, **_: Any
    ) -> bytes:
        """Return the bytes from ``start`` to ``end``."""
        assert start is not None and end is not None
        session = await self.set_session()
        asked = {"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity"}
        wait = _build_timeout(end - start)
        async with session.get(self.encode_url(url), headers=asked, timeout=wait) as answer:
            self._raise_not_found_for_status(answer, url)
            if answer.status != HTTP_PARTIAL_CONTENT:
                raise StorageError(f"{url}: the server cannot send parts of a file. Copy the file")
            found = CONTENT_RANGE.fullmatch(answer.headers.get("Content-Range", ""))
            self._check_version(url, answer)
            data = await _read(answer, end - start, url)
            if not found or int(found[1]) != start or len(data) != end - start:
                raise _wrong_bytes_error(url)
            return data

    async def _get_file(self, url: str, path: str, **_: Any) -> None:
        """Copy a file of the size that the server reported."""
        size = (await self._info(url))["size"]
        free = shutil.disk_usage(Path(path).parent).free
        if size > free:
            raise StorageError(f"{url} has {size} bytes, but only {free} are free. Free some")
        session = await self.set_session()
        with Path(path).open("wb") as out:
            async with session.get(
                self.encode_url(url),
                headers={"Accept-Encoding": "identity"},
                timeout=_build_timeout(size),
            ) as answer:
                self._raise_not_found_for_status(answer, url)
                self._check_version(url, answer)
                left = size
                while left and (data := await _read(answer, min(left, COPY_STEP_BYTES), url)):
                    out.write(data)
                    left -= len(data)
        if left:
            raise _wrong_bytes_error(url)

    async def _find(self, *_: Any, **__: Any) -> list[str]:
        """Return nothing: web pages with links are not folders, and could go on for ever."""
        return []

    def _check_version(self, url: str, answer: Any) -> None:
        """Raise StorageError if an answer is compressed, or from another version of the file."""
        expected = self._versions.get(url, {})
        if any(answer.headers.get(name, said) != said for name, said in expected.items()):
            raise StorageError(f"{url} changed while it was read. Run it again")
        if answer.headers.get("Content-Encoding", "identity") != "identity":
            raise _wrong_bytes_error(url)


async def _read(answer: Any, size: int, url: str) -> bytes:
    """Read ``size`` bytes of an answer, or all if there are fewer."""
    parts, left = [], size
    try:
        while left and (data := await answer.content.read(left)):
            parts.append(data)
            left -= len(data)
    except TimeoutError:
        raise _slow_server_error(url) from None
    return b"".join(parts)


def _build_timeout(size: int) -> ClientTimeout:
    """Return the timeout of an answer of this size."""
    return ClientTimeout(total=PATIENCE_S + size / SLOWEST_BPS)


def _slow_server_error(url: str) -> StorageError:
    return StorageError(f"{url}: the server is too slow. Try later, or copy the file")


def _wrong_bytes_error(url: str) -> StorageError:
    return StorageError(
        f"{url}: the server sent other bytes than requested. Copy the file, and check it"
    )
