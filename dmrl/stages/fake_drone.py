"""``dmrl fake-drone``: a simulated flight, sent as Crazyflies and AI-decks send theirs."""

import signal
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dmrl.simulation.settings import DroneSettings as Settings
from dmrl.terminal.arguments import Flat
from dmrl.terminal.progress import say
from dmrl.terminal.tables import print_table

if TYPE_CHECKING:
    from dmrl.simulation.drone_fleet import Fleet

LINGER_S = 3.0
"""Longest time that drones answer after the flight, while somebody still listens."""
COLUMNS = ("from", "sent", "dropped")
DEFAULTS = Settings()


def run(flight: Path, uris: Sequence[str], cameras: Sequence[int], settings: Settings) -> "Fleet":
    """Send the flight until it is over, or Ctrl-C; return the drones.

    Raises
    ------
    SettingError, RecordingError
        As `dmrl.simulation.drone_fleet.fleet`.
    """
    from dmrl.simulation.drone_fleet import LOOPBACK, fleet

    ended = threading.Event()
    with fleet(flight, uris, cameras, settings) as flying:
        previous = signal.signal(signal.SIGINT, lambda *_: ended.set())
        try:
            places = [f"udp://{LOOPBACK}:{drone.port}" for drone in flying.drones]
            places += [f"{LOOPBACK}:{camera.port}" for camera in flying.cameras]
            if cameras and settings.speed != 1 and settings.sends != "streamer":
                say(
                    "recorded images will not match the log: without the drone's time, they have "
                    "that of arrival, at another speed. Pass --sends streamer"
                )
            say(f"listening at {', '.join(places)}; takes off when its log is asked for")
            while not ended.wait(0.1) and not flying.clock.landed:
                pass
            # A link whose other end vanishes loses what it has not yet taken.
            linger_s = time.monotonic() + LINGER_S
            while flying.has_listeners() and time.monotonic() < linger_s and not ended.wait(0.1):
                pass
        finally:
            signal.signal(signal.SIGINT, previous)
    return flying


def command(
    *,
    flight: Path,
    uri: Annotated[list[str], Parameter(negative=())],
    camera: Annotated[list[int] | None, Parameter(negative=())] = None,
    settings: Flat[Settings] = DEFAULTS,
) -> None:
    """Send a simulated flight as Crazyflies and AI-decks do, to try record with.

    It takes off when the first log is asked for, and ends when the flight does, or up to 3 s
    later while somebody still listens.

    Parameters
    ----------
    flight
        A recording of `dmrl fly`.
    uri
        udp://HOST:PORT where a robot of the flight listens; repeat for the next robots.
    camera
        TCP port of the first robot's camera; repeat for the next.
    """
    flying = run(flight, uri, camera or [], settings)
    print_table("", COLUMNS, flying.count_packets())
