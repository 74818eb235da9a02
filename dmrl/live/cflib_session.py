"""Sessions of cflib, which is imported when a link is opened. Only this module uses cflib.

cflib is GPL-3.0, and therefore an extra.
"""

import logging
import socket
import threading
import time
from contextlib import suppress
from typing import Any

from dmrl.errors import MissingExtra, SettingError
from dmrl.live.log_blocks import SLOW_PERIOD_MS, LogPlan, RequestedBlock

UDP_BUFFER_BYTES = 1 << 22
"""Requested size of the receive buffer, so that a busy computer loses no packets. The system may
grant less.
"""


def load_cflib() -> None:
    """Import cflib and initialise its drivers.

    Raises
    ------
    MissingExtra
        If it is not installed.
    """
    try:
        import cflib.crtp  # noqa: PLC0415 - an extra
        from cflib.crazyflie import Crazyflie  # noqa: F401, PLC0415
    except ModuleNotFoundError as e:
        if (e.name or "").split(".")[0] != "cflib":
            raise
        raise MissingExtra("cflib", "record", "dmrl record") from None
    log = logging.getLogger("cflib")
    if not log.handlers:
        # `LinkStatus` reports the same, more clearly.
        log.addHandler(logging.NullHandler())
        log.propagate = False
    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers()


def check_uri(uri: str) -> None:
    """Raise SettingError unless a driver of cflib accepts the address.

    Raises
    ------
    MissingExtra
        If cflib is not installed.
    SettingError
        If no driver accepts it.
    """
    load_cflib()
    scheme, rest = uri.partition("://")[::2]
    host, port = rest.rpartition(":")[::2]
    bad_port = scheme in ("udp", "tcp") and not (host and port.isdecimal() and int(port) < 65536)
    if scheme not in ("radio", "usb", "udp", "tcp") or not rest or bad_port:
        raise SettingError(
            f"{uri} is no address of a Crazyflie. Use radio://0/80/2M/E7E7E7E7E7 or "
            "udp://127.0.0.1:19850"
        )


class CflibSession:
    """One session of a link: opened, started, closed.

    Parameters
    ----------
    cache
        Folder where cflib caches the drones' tables of contents.

    Attributes
    ----------
    ready
        Set when the drone's log can be requested.
    lost, refused
        Reason why the link ended, or why a block was rejected; empty without an error.
    last_packet_s
        Time of the last packet, monotonic; 0: none yet.
    """

    def __init__(self, cache: str) -> None:
        from cflib.crazyflie import Crazyflie  # noqa: PLC0415 - an extra

        crazyflie = Crazyflie(rw_cache=cache)
        self.ready = threading.Event()
        self.lost = ""
        self.refused = ""
        self.last_packet_s = self._opened_s = 0.0
        self._drone = crazyflie
        self._configs: list[Any] = []
        # Closing a link would send a set-point of zero, which drops a drone that flies on its
        # own.
        crazyflie.commander.send_setpoint = lambda *_: None
        crazyflie.connected.add_callback(lambda _: self.ready.set())
        crazyflie.connection_failed.add_callback(self._on_lost)
        crazyflie.connection_lost.add_callback(self._on_lost)
        crazyflie.packet_received.add_callback(self._on_packet)

    def open(self, uri: str) -> None:
        """Start to connect; `ready` or `lost` reports the result."""
        self._drone.open_link(uri)
        self._opened_s = time.monotonic()
        link = getattr(self._drone.link, "socket", None)
        if isinstance(link, socket.socket):
            with suppress(OSError):  # closed already: `lost` reports it
                link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, UDP_BUFFER_BYTES)

    def idle_time_s(self) -> float:
        """Return the seconds since the last packet."""
        return time.monotonic() - max(self.last_packet_s, self._opened_s)

    def list_variables(self) -> dict[str, str]:
        """Return the type of each log variable."""
        groups = self._drone.log.toc.toc
        return {
            f"{group}.{name}": element.ctype
            for group, elements in groups.items()
            for name, element in elements.items()
        }

    def start_blocks(self, wanted: LogPlan, take: Any) -> None:
        """Request all blocks from the drone.

        Raises
        ------
        SettingError
            If cflib rejects a block.
        """
        for number, block in enumerate(wanted.blocks):
            config = self._build_config(number, block)
            config.data_received_cb.add_callback(take)
            config.error_cb.add_callback(self._on_rejected)
            try:
                self._drone.log.add_config(config)
            except (KeyError, AttributeError) as e:
                raise SettingError(f"cflib rejects block {number}: {e}. Log fewer variables") from e
            config.start()
            self._configs.append(config)

    def _build_config(self, number: int, block: RequestedBlock) -> Any:
        from cflib.crazyflie.log import LogConfig  # noqa: PLC0415 - an extra

        name = "slow" if block.period_ms == SLOW_PERIOD_MS else f"block {number}"
        config = LogConfig(name, block.period_ms)
        for variable in block.variables:
            config.add_variable(variable.name, variable.sent_as)
        return config

    def close(self) -> None:
        """Stop the blocks and end the link."""
        for config in self._configs:
            config.stop()
        self._drone.close_link()

    def _on_lost(self, _uri: str, why: str) -> None:
        self.lost = why or "lost"

    def _on_rejected(self, _block: Any, why: str) -> None:
        self.refused = why

    def _on_packet(self, _packet: Any) -> None:
        self.last_packet_s = time.monotonic()
