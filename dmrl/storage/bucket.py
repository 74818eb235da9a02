"""Read and write S3 buckets, whose servers are not trusted.

s3fs reads whole answers into memory, follows redirects, lists without end, and takes every upload
for stored. Here an answer has a size and a time limit, belongs to one version of the object, and an
upload is complete once the server reports its size and hash.
"""

import asyncio
import hashlib
import re
import time
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path
from typing import Any

from aiobotocore.httpsession import AIOHTTPSession
from aiohttp import ClientTimeout
from botocore.exceptions import ConnectTimeoutError, HTTPClientError, ReadTimeoutError
from s3fs import S3FileSystem

from dmrl.errors import DmrlError, StorageError
from dmrl.guards import limits

PATIENCE_S, SLOWEST_BPS = 30.0, 50_000
"""Timeout of an answer: a fixed part, seconds, and a minimum rate, bytes per second."""
CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/(?:\d+|\*)")
PART_BYTES = 50 << 20
"""Size of the parts of an upload; an object has at most `PARTS` of them."""
PARTS = 10_000
ENCRYPTED_KEYS = ("SSEKMSKeyId", "SSECustomerAlgorithm")
"""Properties of objects whose ETag is not an MD5 hash."""


class BucketFileSystem(S3FileSystem):  # type: ignore[misc]
    """File system of S3 buckets, for `dmrl.storage.system`."""

    protocol = ("s3",)
    checks_version = True

    def __init__(self, **given: Any) -> None:
        config = {"http_session_cls": _CarefulSession}
        super().__init__(config_kwargs=config, **given)

    async def _cat_file(
        self,
        path: str,
        start: int | None = None,
        end: int | None = None,
        version: str | None = None,
        **_: Any,
    ) -> bytes:
        """Return the bytes from ``start`` to ``end`` of one version of an object."""
        if start is None or end is None:
            info = await self._info(path)
            start, end, version = 0, int(info["size"]), info["ETag"]
        bucket, key, _version_id = self.split_path(path)
        condition = {"IfMatch": version} if version else {}
        asked = {"Range": f"bytes={start}-{end - 1}"} if end > start else {}
        try:
            answer = await self._call_s3("get_object", Bucket=bucket, Key=key, **condition, **asked)
        except OSError as e:
            if _has_code(e, "PreconditionFailed", "412", "InvalidRange", "416"):
                raise changed_error(f"s3://{path}") from None
            raise
        try:
            if version and answer.get("ETag", version) != version:
                raise changed_error(f"s3://{path}")
            if end == start:
                return b""
            found = answer.get("ContentRange", "")
            return await read_range(answer["Body"], found, start, end, f"s3://{path}")
        finally:
            answer["Body"].close()

    async def _list_pages(self, method: str, **given: Any) -> AsyncIterator[dict[str, Any]]:
        """Yield the pages of a listing that makes progress, up to the limit of objects."""
        url, count, begun = f"s3://{given['Bucket']}/{given['Prefix']}", 0, None
        async for page in super()._list_pages(method, **given):
            begun = begun or time.monotonic()
            count += len(page.get("Contents", ())) + len(page.get("CommonPrefixes", ()))
            if count > limits.LISTED_FILES:
                raise StorageError(
                    f"{url}: the server lists more than {limits.LISTED_FILES} objects. Name a "
                    "folder with fewer"
                )
            yield page
            patience_s = limits.LISTING_S + count / limits.LISTED_PER_S
            if page.get("IsTruncated") and time.monotonic() - begun > patience_s:
                raise slow_server_error(url)

    async def _put_file(self, lpath: str, rpath: str, **given: Any) -> None:
        """Upload a file, and compare the size and hash that the server reports."""
        size = Path(lpath).stat().st_size
        part_size = max(PART_BYTES, -(-size // PARTS))
        await super()._put_file(lpath, rpath, chunksize=part_size, **given)
        bucket, key, _ = self.split_path(rpath)
        try:
            stored = await self._call_s3("head_object", Bucket=bucket, Key=key)
        except FileNotFoundError:
            raise _not_stored_error(rpath) from None
        tag = str(stored.get("ETag", "")).strip('"')
        expected = compute_tag(Path(lpath), part_size, parted="-" in tag)
        is_hash = len(tag) == len(expected) and not any(stored.get(k) for k in ENCRYPTED_KEYS)
        if stored["ContentLength"] != size or (is_hash and tag != expected):
            await self._rm_file(rpath)
            raise _not_stored_error(rpath)


def compute_tag(path: Path, part_size: int, *, parted: bool) -> str:
    """Return the ETag of a stored file: its MD5, or that of the MD5s of its parts."""
    md5 = partial(hashlib.md5, usedforsecurity=False)
    whole, parts = md5(), []
    with path.open("rb") as stream:
        while data := stream.read(part_size):
            whole.update(data)
            parts.append(md5(data).digest())
    return f"{md5(b''.join(parts)).hexdigest()}-{len(parts)}" if parted else whole.hexdigest()


class _CarefulSession(AIOHTTPSession):  # type: ignore[misc]
    """Connections that follow no redirect, and whose answers have a size and a time limit."""

    async def _get_session(self, proxy_url: str | None) -> Any:
        return _LimitedRequests(await super()._get_session(proxy_url))

    async def send(self, request: Any) -> Any:
        """Send a request; raise a StorageError as it is, so that it is not tried again."""
        try:
            return await super().send(request)
        except (HTTPClientError, ReadTimeoutError) as e:
            if isinstance(e, ReadTimeoutError) and not isinstance(e, ConnectTimeoutError):
                raise slow_server_error(request.url) from None
            cause = e.kwargs.get("error")
            raise (cause if isinstance(cause, DmrlError) else e) from None


class _LimitedRequests:
    """The session of aiohttp as `AIOHTTPSession` uses it."""

    def __init__(self, session: Any) -> None:
        self._session = session

    async def request(self, method: str, url: Any, **given: Any) -> Any:
        sent = int(given["headers"].get("Content-Length", 0))
        start, _, last = given["headers"].get("Range", "").removeprefix("bytes=").partition("-")
        size = sent + (int(last) - int(start) if last else limits.ANSWER_BYTES)
        given["timeout"] = ClientTimeout(total=compute_patience_s(size))
        answer = await self._session.request(method, url=url, allow_redirects=False, **given)
        answer.read = partial(_read_document, answer)
        return answer


async def _read_document(answer: Any) -> bytes:
    """Read an answer that is no object: a listing, or an error."""
    url = str(answer.url)
    data = await read_up_to(answer.content, limits.ANSWER_BYTES + 1, url)
    if len(data) > limits.ANSWER_BYTES:
        answer.close()
        raise wrong_bytes_error(url)
    return data


def _has_code(error: OSError, *codes: str) -> bool:
    response = getattr(error.__cause__, "response", None) or {}
    return response.get("Error", {}).get("Code") in codes


def _not_stored_error(path: str) -> StorageError:
    return StorageError(
        f"s3://{path}: the server does not store what it was sent. Check the bucket, and run it "
        "again"
    )


async def read_up_to(stream: Any, size: int, url: str) -> bytes:
    """Read ``size`` bytes of an answer, or all if there are fewer.

    Raises
    ------
    StorageError
        If the server is too slow.
    """
    parts, left = [], size
    try:
        async with asyncio.timeout(compute_patience_s(size)):
            while left and (data := await stream.read(left)):
                parts.append(data)
                left -= len(data)
    except TimeoutError:
        raise slow_server_error(url) from None
    return b"".join(parts)


async def read_range(stream: Any, content_range: str, start: int, end: int, url: str) -> bytes:
    """Return the bytes from ``start`` to ``end``, as the answer to a request for them.

    Raises
    ------
    StorageError
        If the server sends another range, or is too slow.
    """
    found = CONTENT_RANGE.fullmatch(content_range)
    data = await read_up_to(stream, end - start, url)
    if not found or int(found[1]) != start or len(data) != end - start:
        raise wrong_bytes_error(url)
    return data


def compute_patience_s(size: int) -> float:
    """Return the time for an answer of this size, seconds."""
    return PATIENCE_S + size / SLOWEST_BPS


def slow_server_error(url: str) -> StorageError:
    """Return the error for an answer that does not end in time."""
    return StorageError(f"{url}: the server is too slow. Try later, or copy the file")


def wrong_bytes_error(url: str) -> StorageError:
    """Return the error for an answer of other bytes."""
    return StorageError(
        f"{url}: the server sent other bytes than requested. Copy the file, and check it"
    )


def changed_error(url: str) -> StorageError:
    """Return the error for a file that was replaced between two reads."""
    return StorageError(f"{url} changed while it was read. Run it again")
