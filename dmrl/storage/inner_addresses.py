"""Follow redirects of web servers to public addresses only.

A server could otherwise make dmrl read what only this machine or its network may see, such as the
credentials of a cloud. The address is checked when the socket is made, so names cannot be rebound.
"""

import ipaddress
import socket
from contextvars import ContextVar
from typing import Any

from aiohttp import (
    AddrInfoType,
    ClientHandlerType,
    ClientRequest,
    ClientResponse,
    ClientSession,
    TCPConnector,
)
from yarl import URL

from dmrl.errors import StorageError

_NAMED_URL: ContextVar[str] = ContextVar("named_url", default="")
"""URL that the user named, to which a request belongs."""
_TRUSTED_ORIGIN: ContextVar[bool] = ContextVar("trusted_origin", default=False)
"""Whether the user named the server that a request goes to."""


class RedirectGuard:
    """Origins that the user named: only these may be at an inner address."""

    def __init__(self) -> None:
        self._origins: set[URL] = set()

    def trust(self, url: str) -> None:
        """Allow the server of a URL that the user named, also where it demands https."""
        _NAMED_URL.set(url)
        origin = URL(url).origin()
        self._origins |= {origin, origin.with_scheme("https").with_port(None)}

    async def open_session(self, **given: Any) -> ClientSession:
        """Return a session that raises StorageError before it connects to other inner addresses."""
        connector = TCPConnector(socket_factory=_open_socket)
        return ClientSession(connector=connector, middlewares=[self._mark_origin], **given)

    async def _mark_origin(
        self, request: ClientRequest, handler: ClientHandlerType
    ) -> ClientResponse:
        before = _TRUSTED_ORIGIN.set(request.url.origin() in self._origins)
        try:
            return await handler(request)
        finally:
            _TRUSTED_ORIGIN.reset(before)


def is_inner(address: str) -> bool:
    """Return whether an IP address is of this machine or of a private network."""
    found = ipaddress.ip_address(address.partition("%")[0])
    mapped = found.ipv4_mapped if isinstance(found, ipaddress.IPv6Address) else None
    return not (mapped or found).is_global


def _open_socket(info: AddrInfoType) -> socket.socket:
    family, kind, protocol, _, address = info
    if not _TRUSTED_ORIGIN.get() and is_inner(str(address[0])):
        raise StorageError(
            f"{_NAMED_URL.get()}: the server redirects to {address[0]}, an inner address. Name the "
            "file there if you trust the server"
        )
    return socket.socket(family, kind, protocol)
