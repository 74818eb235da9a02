"""Queries in a sandboxed process: every failure gives a one-line error."""

import os
import socket
from pathlib import Path

import pytest

from dmrl.errors import SettingError
from dmrl.guards import cage
from dmrl.guards.cage import run_caged

pytestmark = pytest.mark.heavy


def echo(request: bytes) -> bytes:
    return request[::-1]


def refuse(request: bytes) -> bytes:
    raise SettingError(f"{request.decode()} is refused. Ask for less")


def take_memory(request: bytes) -> bytes:
    return bytes(int(request))[:1]


def abort(_: bytes) -> bytes:
    os.abort()


def connect_to_localhost(_: bytes) -> bytes:
    """Try to connect to a local port and return the error number."""
    with socket.socket() as stream:
        stream.settimeout(5)
        return str(stream.connect_ex(("127.0.0.1", 9))).encode()


def spin(_: bytes) -> bytes:
    while True:
        pass


@pytest.fixture(autouse=True)
def importable_module(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the sandboxed process import this module."""
    before = os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), before]))


def run(name: str, request: bytes = b"") -> bytes:
    return run_caged(f"test_cage:{name}", request, "the query 'x'")


def test_bytes_go_in_and_come_out() -> None:
    assert run("echo", b"abc") == b"cba"


def test_dmrl_error_is_raised_in_the_caller() -> None:
    with pytest.raises(SettingError, match=r"^'?x is refused. Ask for less"):
        run("refuse", b"x")


def test_memory_limit_stops_large_queries_only() -> None:
    assert run("take_memory", b"100000000") == b"\0"
    with pytest.raises(SettingError, match="the query 'x' needs more than 500 MB"):
        run("take_memory", b"2000000000")


def test_crash_gives_one_line_error() -> None:
    with pytest.raises(SettingError, match="the query 'x'"):
        run("abort")


def test_cpu_time_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        cage,
        "CHILD_CODE",
        cage.CHILD_CODE.replace("main()", "")
        + "import dmrl.guards.cage as c; c.CPU_TIME_S = 1; main()",
    )
    with pytest.raises(SettingError, match="CPU time"):
        run("spin")


@pytest.mark.skipif(os.geteuid() != 0, reason="a system may forbid users namespaces")
def test_the_child_has_no_network() -> None:
    """Without network interfaces even localhost is unreachable: ENETUNREACH, not ECONNREFUSED."""
    assert int(run("connect_to_localhost")) == 101
