"""Status of the links as a table on standard error that is redrawn continuously."""

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Self

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table

from dmrl.errors import to_one_line
from dmrl.live.crazyflie_link import CrazyflieLink
from dmrl.live.queue import LinkStatus

RATE_WINDOW_S = 1.0
"""Shortest window over which rates are measured."""
BATTERY_LOW_V = 3.5


class _RateMeter:
    """Rate at which a count increases, per second."""

    def __init__(self) -> None:
        self._since_s, self._count, self.per_s = time.monotonic(), 0, 0.0

    def update(self, count: int) -> float:
        passed_s = time.monotonic() - self._since_s
        if passed_s >= RATE_WINDOW_S:
            self.per_s = (count - self._count) / passed_s
            self._since_s, self._count = time.monotonic(), count
        return self.per_s


class StatusTable:
    """Status table on a terminal; elsewhere only messages are printed.

    Parameters
    ----------
    links
        Links of the robots.
    cameras
        Status of the cameras.
    """

    def __init__(self, links: Sequence[CrazyflieLink], cameras: Sequence[LinkStatus]) -> None:
        self._links = links
        self._healths = [*(link.health for link in links), *cameras]
        self._rates = {health.source: _RateMeter() for health in self._healths}
        self._console = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
        self._live: Live | None = None
        self._started_s = time.monotonic()

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def print_message(self, line: str) -> None:
        """Print a message above the table."""
        self._console.print(to_one_line(line))

    def update(self, messages: int) -> None:
        """Draw the table again.

        Parameters
        ----------
        messages
            Number of messages written so far.
        """
        rates = {h.source: self._rates[h.source].update(h.received) for h in self._healths}
        if self._live is not None:
            with suppress(BlockingIOError):
                self._live.update(self._build_table(rates, messages), refresh=True)

    def _build_table(self, rates: dict[str, float], messages: int) -> Table:
        passed_s = int(time.monotonic() - self._started_s)
        title = f"{passed_s // 60}:{passed_s % 60:02d}  {messages} messages  (Ctrl-C ends it)"
        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
        for column in ("", "state", "per s", "lost", "broken", "battery", "ranges"):
            right = column in ("per s", "lost", "broken")
            table.add_column(column, justify="right" if right else "left", no_wrap=True)
        links = {link.health.source: link for link in self._links}
        for health in self._healths:
            rate = f"{rates[health.source]:.1f}"
            counts = (rate, str(health.lost), str(health.broken))
            more = _describe_robot(links[health.source]) if health.source in links else ("", "")
            table.add_row(health.source, health.state, *counts, *more)
        return table


def _describe_robot(link: CrazyflieLink) -> tuple[str, str]:
    """Return battery and distances of a robot, as text."""
    reading = link.reading
    if reading is None:
        return "", ""
    battery = "" if reading.battery_v is None else f"{reading.battery_v:.2f} V"
    if reading.battery_v is not None and reading.battery_v < BATTERY_LOW_V:
        battery += " low"
    ranges = ", ".join(f"{peer} {value:.2f} m" for peer, value in sorted(reading.ranges_m.items()))
    return battery, ranges
