"""Construction, shutdown and reports of the links and cameras of recorded robots."""

from collections import Counter
from collections.abc import Sequence

from dmrl.errors import SettingError
from dmrl.geometry.camera_file import read_camera, warn_of_mount
from dmrl.live.camera_link import CameraClient
from dmrl.live.cflib_session import check_uri
from dmrl.live.crazyflie_link import CrazyflieLink
from dmrl.live.image_assembly import ColourMode, StoredFormat
from dmrl.live.queue import SampleQueue
from dmrl.live.receive_clocks import HostClock
from dmrl.live.robot_options import RobotOptions, parse_peers


def check_robots(robots: Sequence[RobotOptions]) -> None:
    """Raise SettingError unless these robots can be recorded together.

    Raises
    ------
    SettingError
        If there are none, two share a name or an address, or an address is invalid.
    """
    if not robots:
        raise SettingError("no robot to record. Pass robots: --robot cf1=URI")
    for what, values in (("name", [r.name for r in robots]), ("address", [r.uri for r in robots])):
        if twice := [value for value, count in Counter(values).items() if count > 1]:
            raise SettingError(f"two robots with the {what} {twice[0]}. Give each its own")
    for robot in robots:
        check_uri(robot.uri)


def build_links(
    robots: Sequence[RobotOptions],
    peer: Sequence[str],
    rate_hz: float,
    feed: SampleQueue,
    now: HostClock,
) -> dict[str, CrazyflieLink]:
    """Build a link to each robot, by name, not yet started.

    Parameters
    ----------
    robots
        Robots to record.
    peer
        ``N=NAME`` for distances that are not to robot cf<N>.
    rate_hz
        Log packets per second and block.
    feed, now
        See `CrazyflieLink`.
    """
    names, period_ms = [robot.name for robot in robots], 10 * max(round(100 / rate_hz), 1)
    peers = {name: parse_peers(name, names, peer) for name in names}
    return {
        r.name: CrazyflieLink(r.name, r.uri, peers[r.name], period_ms, feed, now) for r in robots
    }


def build_cameras(
    robots: Sequence[RobotOptions],
    links: dict[str, CrazyflieLink],
    form: tuple[ColourMode, StoredFormat],
    feed: SampleQueue,
    now: HostClock,
) -> list[CameraClient]:
    """Build a client for each robot's camera, not yet started.

    Parameters
    ----------
    robots
        Robots to record.
    links
        Their links, which convert the robots' times.
    form
        Colours of the cameras, and the stored format of images.
    feed, now
        See `CameraClient`.
    """
    calibrations = {r.name: read_camera(r.calibration) if r.calibration else None for r in robots}
    for name, camera in calibrations.items():
        if camera is not None:
            warn_of_mount(name, camera)
    return [
        CameraClient(
            robot.name,
            *robot.camera,
            feed,
            now,
            colours=form[0],
            stored=form[1],
            camera=calibrations[robot.name],
            robot_time=links[robot.name].to_host_time_ns,
        )
        for robot in robots
        if robot.camera
    ]


def describe_no_data(out: object, links: Sequence[CrazyflieLink]) -> str:
    """Return the error text for a recording without any sample."""
    states = ", ".join(f"{link.robot} at {link.uri}: {link.health.state}" for link in links)
    return f"no data for {out} ({states}). Check that the drone is on, and the address"
