"""Fixtures: a local bucket server, and the number of bytes read from it."""

import logging
from collections.abc import Iterator
from typing import Any
from urllib import request

import pytest

from dmrl.storage.system import get_filesystem


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Start moto's S3 server and return its address; the environment leads fsspec to it."""
    moto = pytest.importorskip("moto.server")
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    running = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        forget_filesystems()
        request.urlopen(
            f"http://{host}:{port}/moto-api/reset", data=b""
        ).close()  # buckets of other tests
        yield f"http://{host}:{port}"
    forget_filesystems()
    running.stop()


def forget_filesystems() -> None:
    """Clear the cached file systems, which keep the address they were made with."""
    from s3fs import S3FileSystem  # noqa: PLC0415 - in tests of it alone

    get_filesystem.cache_clear()
    S3FileSystem.clear_instance_cache()


@pytest.fixture(scope="module")
def lab(server: str) -> Any:
    """Return fsspec's S3 file system, with an empty bucket called lab."""
    get_filesystem("s3").mkdir("lab")
    return get_filesystem("s3")


@pytest.fixture
def fetched_bytes(lab: Any, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list to which every read of an object appends its number of bytes."""
    sizes: list[int] = []
    real = lab._call_s3

    async def call_and_count(method: str, *given: Any, **named: Any) -> Any:
        found = await real(method, *given, **named)
        if method == "get_object":
            sizes.append(int(found["ContentLength"]))
        return found

    monkeypatch.setattr(lab, "_call_s3", call_and_count)
    return sizes
