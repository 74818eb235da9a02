"""Drones and cameras that send a recorded flight over the network, as real ones do."""

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from dmrl import topics
from dmrl.errors import RecordingError, SettingError
from dmrl.geometry.frames import Array
from dmrl.live.log_blocks import parse_robot_number
from dmrl.live.simulated import flight_source
from dmrl.live.simulated.aideck_server import SimulatedCamera
from dmrl.live.simulated.crazyflie_server import SimulatedCrazyflie
from dmrl.live.threads import stop_all
from dmrl.recording import read, read_summary, read_table
from dmrl.recording.protobuf.arrow_arrays import to_numpy
from dmrl.simulation.settings import DroneSettings

LOOPBACK = "127.0.0.1"
DIES = re.compile(r"(?P<robot>[\w-]+)=(?P<first>\d+(\.\d+)?)(:(?P<last>\d+(\.\d+)?))?")


@dataclass(frozen=True, slots=True)
class Fleet:
    """Drones and cameras, listening."""

    drones: tuple[SimulatedCrazyflie, ...]
    cameras: tuple[SimulatedCamera, ...]
    clock: flight_source.FlightClock

    def has_listeners(self) -> bool:
        """Return whether a client still reads the log of a drone."""
        return any(drone.is_logging for drone in self.drones)

    def count_packets(self) -> list[tuple[str, int, int]]:
        """Return a row per drone and camera: name, packets sent, packets dropped."""
        rows = [(drone.robot, drone.sent, drone.dropped) for drone in self.drones]
        return rows + [(f"{c.robot} camera", c.sent, c.dropped) for c in self.cameras]


@contextmanager
def fleet(
    flight: Path, uris: Sequence[str], cameras: Sequence[int], settings: DroneSettings
) -> Iterator[Fleet]:
    """Run drones and cameras inside the block.

    Parameters
    ----------
    flight
        A recording with attitude, velocity, height and distances.
    uris
        Address of each robot of the flight, in the order of their names.
    cameras
        Port of each robot's camera; 0: any.
    settings
        See `DroneSettings`.

    Raises
    ------
    SettingError
        If there are more addresses than robots, or one cannot be had.
    RecordingError
        If the flight lacks sensors that a drone logs, or a camera's images.
    """
    robots = _robots(flight, uris, cameras)
    faults = _faults(robots, settings)
    flights = {robot: _flight(flight, robot) for robot in robots}
    clock = flight_source.FlightClock(settings.speed, max(f.end_s for f in flights.values()))
    start_ns = read_summary(flight).start_ns
    drones: list[SimulatedCrazyflie] = []
    sending: list[SimulatedCamera] = []
    # Each has its socket as soon as it is made, so what was made is ended if the next fails.
    with ExitStack() as made:
        for k, (robot, uri) in enumerate(zip(robots, uris, strict=False)):
            seed = settings.seed * 1000 + k
            behaves = flights[robot], clock, faults[robot], seed
            drones.append(SimulatedCrazyflie(robot, address(uri), *behaves))
            made.callback(drones[-1].close)
        for k, (robot, port) in enumerate(zip(robots, cameras, strict=False)):
            pictures, seed = _pictures(flight, robot, start_ns), settings.seed * 1000 + 500 + k
            sends = pictures, clock, faults[robot], settings.sends, seed
            sending.append(SimulatedCamera(robot, (LOOPBACK, port), *sends))
            made.callback(sending[-1].close)
        made.callback(stop_all, [*drones, *sending])
        for thread in (*drones, *sending):
            thread.start()
        yield Fleet(tuple(drones), tuple(sending), clock)


def _robots(flight: Path, uris: Sequence[str], cameras: Sequence[int]) -> list[str]:
    known = topics.list_robots(tuple(read_summary(flight).topics), topics.ATTITUDE)
    if not known:
        raise RecordingError(f"{flight} has no /<robot>/attitude. Make one: dmrl fly")
    if not 0 < len(uris) <= len(known) or len(cameras) > len(uris):
        raise SettingError(
            f"{len(uris)} --uri and {len(cameras)} --camera for {len(known)} robots "
            f"({', '.join(known)}). Pass one --uri per robot, and at most as many --camera"
        )
    if wrong := [port for port in cameras if not 0 <= port < 65536]:
        raise SettingError(f"--camera {wrong[0]}: ports go from 1 to 65535. Name another")
    pictured = topics.list_robots(tuple(read_summary(flight).topics))
    if blind := [robot for robot in known[: len(cameras)] if robot not in pictured]:
        raise RecordingError(f"{flight} has no pictures of {blind[0]}. Try: dmrl fly --camera")
    return known[: len(uris)]


def address(uri: str) -> tuple[str, int]:
    """Parse host and port of "udp://HOST:PORT".

    Raises
    ------
    SettingError
        If the text has another form.
    """
    try:
        parts = urlsplit(uri)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not uri.startswith("udp://") or not host or port is None:
        raise SettingError(f"--uri {uri}: write udp://HOST:PORT, such as udp://127.0.0.1:19850")
    return host, port


def _faults(
    robots: Sequence[str], settings: DroneSettings
) -> dict[str, flight_source.SimulatedFaults]:
    dead: dict[str, tuple[float, float]] = {}
    for text in settings.dies:
        found = DIES.fullmatch(text)
        if found is None or found["robot"] not in robots:
            raise SettingError(
                f"--dies {text}: write ROBOT=S or ROBOT=S:T with one of {', '.join(robots)}"
            )
        last = float(found["last"]) if found["last"] else float("inf")
        dead[found["robot"]] = float(found["first"]), last
    alive = (float("inf"), float("inf"))
    return {
        robot: flight_source.SimulatedFaults(
            settings.drop, dead.get(robot, alive), settings.boot_ms, k * settings.drift_ppm
        )
        for k, robot in enumerate(robots)
    }


def _flight(path: Path, robot: str) -> flight_source.SimulatedFlight:
    start_ns, held = read_summary(path).start_ns, read_summary(path).topics
    numbered = (
        n for t in held if (n := topics.parse_topic(topics.RANGE, t)) and n["robot"] == robot
    )
    peers = sorted(n["peer"] for n in numbered if parse_robot_number(n["peer"]) is not None)

    def signal_of(topic: str, *fields: str) -> tuple[Array, Array]:
        table = read_table(path, topic, fields=fields)
        if not table.num_rows:
            raise RecordingError(f"{path}: {topic} is empty. Take another flight")
        values = np.column_stack([to_numpy(table[field]) for field in fields]).astype(float)
        return (to_numpy(table["log_time"]) - start_ns) * 1e-9, values

    angles = ("roll_rad", "pitch_rad", "yaw_rad", "yaw_rate_radps")
    height_s, height = signal_of(topics.HEIGHT(robot), "height_m")
    ranges = {peer: signal_of(topics.RANGE(robot, peer), "range_m") for peer in peers}
    return flight_source.SimulatedFlight(
        signal_of(topics.ATTITUDE(robot), *angles),
        signal_of(topics.VELOCITY(robot), "vx_mps", "vy_mps"),
        (height_s, height[:, 0]),
        {peer: (time_s, range_m[:, 0]) for peer, (time_s, range_m) in ranges.items()},
    )


def _pictures(path: Path, robot: str, start_ns: int) -> flight_source.FlightImages:
    for stamped in read(path, topics.CAMERA_IMAGE(robot)):
        yield (stamped.time_ns - start_ns) * 1e-9, stamped.message.data
