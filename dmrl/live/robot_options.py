"""Parsing of the robots and peers that a user names."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dmrl.errors import SettingError
from dmrl.live.camera_link import parse_address
from dmrl.live.log_blocks import parse_robot_number

ROBOT_NAME = re.compile(r"[A-Za-z0-9_-]+")


@dataclass(frozen=True, slots=True)
class RobotOptions:
    """One robot to record.

    Parameters
    ----------
    name
        Its name in topics.
    uri
        Address of its Crazyflie.
    camera
        Host and port of its AI-deck; None: it has none.
    calibration
        TOML file with its camera; None: the AI-deck of the paper.
    """

    name: str
    uri: str
    camera: tuple[str, int] | None = None
    calibration: Path | None = None


def parse_robot(text: str) -> RobotOptions:
    """Parse a robot from the command line: ``cf1=URI[,camera=HOST:PORT][,calibration=FILE]``.

    Raises
    ------
    SettingError
        If the text has another form.
    """
    name, equals, rest = text.partition("=")
    uri, *options = rest.split(",")
    if not equals or not ROBOT_NAME.fullmatch(name) or not uri:
        raise SettingError(
            f"--robot {text}: not NAME=URI. Use, for example, cf1=radio://0/80/2M/E7E7E7E7E7"
        )
    given = dict(option.partition("=")[::2] for option in options)
    if unknown := sorted(given.keys() - {"camera", "calibration"}):
        raise SettingError(f"--robot {text}: no option {unknown[0]}. Use camera or calibration")
    camera = parse_address(given["camera"]) if "camera" in given else None
    calibration = Path(given["calibration"]) if "calibration" in given else None
    return RobotOptions(name, uri, camera, calibration)


def parse_peers(robot: str, names: Sequence[str], given: Sequence[str]) -> dict[int, str]:
    """Return the peers of a robot's ``ranging.distance<number>``, by number.

    Parameters
    ----------
    robot
        The robot.
    names
        All robots.
    given
        "N=NAME" texts of the user; empty: the number at the end of each name.

    Raises
    ------
    SettingError
        If a text has another form.
    """
    found: dict[int, str] = {}
    for text in given:
        number, equals, name = text.partition("=")
        if not equals or not number.isdecimal() or not ROBOT_NAME.fullmatch(name):
            raise SettingError(f"--peer {text}: not N=NAME. Use, for example, 1=cf2")
        found[int(number)] = name
    if not given:
        numbers = {name: parse_robot_number(name) for name in names}
        found = {number: name for name, number in numbers.items() if number is not None}
    return {number: name for number, name in found.items() if name != robot}
