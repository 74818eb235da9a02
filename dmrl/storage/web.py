"""Read files from web servers, which are not trusted: only requested bytes are accepted.

fsspec reads the whole answer of a server into memory. Here an answer is read up to the
requested size, and must be that range of the same version of the file.
"""

from typing import Any

from fsspec.implementations.http import HTTPFileSystem

from dmrl.errors import StorageError
from dmrl.storage.inner_addresses import RedirectGuard
from dmrl.storage.server_answers import build_timeout, changed_error, read_range, wrong_bytes_error

"""Bytes that are read at a time when a file is copied."""
HTTP_PARTIAL_CONTENT = 206


class WebFileSystem(HTTPFileSystem):  # type: ignore[misc]
    """File system of web servers, for `dmrl.storage.system`."""

    protocol = ("http", "https")
    checks_version = True

    def __init__(self, **given: Any) -> None:
        # A compressed answer could decompress to any size.
        client_options = {"auto_decompress": False, "timeout": build_timeout(0)}
        self._guard = RedirectGuard()
        super().__init__(client_kwargs=client_options, get_client=self._guard.open_session, **given)

    async def _info(self, url: str, **given: Any) -> dict[str, Any]:
        """Return size and version."""
        self._guard.trust(url)
        try:
            info: dict[str, Any] = await super()._info(url, **given)
        except FileNotFoundError as e:
            raise e.__cause__ if isinstance(e.__cause__, StorageError) else e from None
        if info["size"] is None:
            raise StorageError(f"{url}: the server does not report its size. Copy the file")
        return info

    async def _cat_file(
        self,
        url: str,
        start: int | None = None,
        end: int | None = None,
        version: dict[str, str] | None = None,
        **_: Any,
    ) -> bytes:
        """Return the bytes from ``start`` to ``end`` of one version of a file."""
        assert start is not None and end is not None
        session = await self.set_session()
        self._guard.trust(url)
        asked = {"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity"}
        wait = build_timeout(end - start)
        async with session.get(self.encode_url(url), headers=asked, timeout=wait) as answer:
            self._raise_not_found_for_status(answer, url)
            if answer.status != HTTP_PARTIAL_CONTENT:
                raise StorageError(f"{url}: the server cannot send parts of a file. Copy the file")
            _check_version(url, answer, version or {})
            found = answer.headers.get("Content-Range", "")
            return await read_range(answer.content, found, start, end, url)

    async def _find(self, *_: Any, **__: Any) -> list[str]:
        """Return nothing: web pages with links are not folders, and could go on for ever."""
        return []


def _check_version(url: str, answer: Any, expected: dict[str, str]) -> None:
    """Raise StorageError if an answer is compressed, or from another version of the file."""
    if any(answer.headers.get(name, said) != said for name, said in expected.items()):
        raise changed_error(url)
    if answer.headers.get("Content-Encoding", "identity") != "identity":
        raise wrong_bytes_error(url)
