"""The page server: which requests are answered, and what the page may load."""

import http.client
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from dmrl.viewer.settings import Web
from dmrl.viewer.window.page_server import DATA_NAME, PageServer

pytest.importorskip("rerun_cli")
pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def server() -> Iterator[PageServer]:
    """Return a server with complete data."""
    with closing(PageServer(Web())) as opened:
        opened.data.write(b"recording")
        opened.data.complete.set()
        yield opened


def request_file(
    server: PageServer, name: str, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    """Request a file under the token; return status, headers and body."""
    address = urlsplit(server.url)
    return request_path(address.port or 0, address.path + name, **headers)


def request_path(port: int, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Request a path; return status, headers and body."""
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.headers), answer.read()


def test_the_page_and_its_data_are_served_under_the_token(server: PageServer) -> None:
    status, headers, page = request_file(server, "")
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert b"<canvas" in page
    assert request_file(server, DATA_NAME)[2] == b"recording"
    assert request_file(server, "re_viewer_bg.wasm")[2].startswith(b"\0asm")


def test_the_page_may_call_no_other_host(server: PageServer) -> None:
    _, headers, page = request_file(server, "")
    policy = dict(
        part.strip().split(" ", 1) for part in headers["Content-Security-Policy"].split(";")
    )
    assert policy["default-src"] == "'none'"
    assert not [
        word for value in policy.values() for word in value.split() if "//" in word or "*" in word
    ]
    assert b"googleapis" not in page
    assert "Access-Control-Allow-Origin" not in headers


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "", "127.0.0.1.evil.example", "192.0.2.1"]
)
def test_another_host_is_refused(server: PageServer, host: str) -> None:
    for name in ("", DATA_NAME):
        status, _, body = request_file(server, name, Host=host)
        assert status == 403
        assert b"recording" not in body


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:1", "127.0.0.1", "[::1]:80"])
def test_names_of_this_computer_are_answered(server: PageServer, host: str) -> None:
    assert request_file(server, DATA_NAME, Host=host)[0] == 200


def test_request_without_token_is_refused(server: PageServer) -> None:
    port = urlsplit(server.url).port or 0
    for path in ("/", f"/{DATA_NAME}", f"/token/{DATA_NAME}", "/../etc/passwd", "/re_viewer.js"):
        assert request_path(port, path)[0] == 404


def test_files_outside_the_page_are_not_served(server: PageServer) -> None:
    for name in ("../", "../../etc/passwd", "%2e%2e/etc/passwd", "index.html", "x.rrd"):
        assert request_file(server, name)[0] == 404


def test_a_second_server_has_another_token(server: PageServer) -> None:
    with closing(PageServer(Web())) as second:
        assert urlsplit(second.url).path != urlsplit(server.url).path


def test_a_server_of_the_network_answers_addresses_and_not_names() -> None:
    with closing(PageServer(Web(bind="0.0.0.0"))) as opened:
        opened.data.complete.set()
        assert request_file(opened, DATA_NAME, Host="192.0.2.7:80")[0] == 200
        assert request_file(opened, DATA_NAME, Host="evil.example")[0] == 403


def test_viewer_program_does_not_keep_running(server: PageServer) -> None:
    children = Path("/proc/self/task")
    if not children.is_dir():
        pytest.skip("no /proc")
    found = "".join(path.read_text() for path in children.glob("*/children")).split()
    # Ignore helpers of multiprocessing that other tests of this process have left.
    programs = [Path(f"/proc/{number}/cmdline").read_bytes() for number in found]
    assert not [words for words in programs if b"rerun" in words], (
        "the program of the viewer still runs"
    )
