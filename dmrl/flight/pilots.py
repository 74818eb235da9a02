"""Pilots that ship with dmrl: follow, keep apart, formation.

The first and the last know their leader by one Kalman filter, `OnboardFilter`, which is also
exported as C. It bridges the misses of a small network: the less certain the leader's place, the
slower a robot flies; when the leader is gone, it stops and turns to where the leader was heading.
"""

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext

import numpy as np

from dmrl import entry_points
from dmrl.errors import SettingError
from dmrl.flight.onboard_input import to_raw
from dmrl.flight.onboard_pilot import CONSTANTS, OnboardFilter
from dmrl.flight.pilot import Command, Observation, PeerTrack, Pilot, Task

NEAR_M = CONSTANTS["NEAR"]
"""Distance below which a pilot moves away from any peer."""
FORMATION_HEIGHTS_M = 0.25, -0.1
"""Robots of a formation fly so far above their leader, in turn: a camera of the AI-deck sees
0.42 rad upwards and 0.67 rad downwards."""


class Follow(Pilot):
    """Fly behind the leader, at the distance of the task and at its height, as ``pilot.c`` does."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self._filter = OnboardFilter(task.distance_m)

    def command(self, seen: Observation) -> Command:
        """Return the command of the filter."""
        return Command(*self._filter.step(*to_raw(seen)))


class KeepApart(Pilot):
    """Hover, and move away from every peer that comes near."""

    def command(self, seen: Observation) -> Command:
        """Return the command away from near peers."""
        return keep_apart(Command(), seen.tracks)


class FormationFilter(OnboardFilter):
    """Filter of a robot whose place beside the leader does not turn with it."""

    def aim(self, x: float, y: float, away: float) -> tuple[float, float]:
        """Return the velocity towards the place in which the robot started."""
        forward, left = self.pose.c * self.distance_m, -self.pose.s * self.distance_m
        return CONSTANTS["GAIN"] * (x - forward), CONSTANTS["GAIN"] * (y - left)


class Formation(Pilot):
    """Keep the place beside the leader in which the robot started, and look at the leader.

    Robots that start around their leader stay apart without seeing each other.
    """

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        above_m = FORMATION_HEIGHTS_M[task.number % 2]
        self._filter = FormationFilter(task.distance_m, above_m=above_m)

    def command(self, seen: Observation) -> Command:
        """Return the command of the filter, without its part towards near peers."""
        return keep_apart(Command(*self._filter.step(*to_raw(seen))), seen.tracks)


def keep_apart(command: Command, tracks: tuple[PeerTrack, ...]) -> Command:
    """Return a command without its part towards near peers, and with one away from them."""
    wanted = np.array(command[:3])
    for track in tracks:
        distance = max(math.hypot(*track.position_m), 1e-6)
        if distance < NEAR_M:
            towards = track.position_m / distance
            wanted -= (max(float(wanted @ towards), 0.0) + (NEAR_M - distance) * 2) * towards
    vx_mps, vy_mps, vz_mps = wanted.tolist()
    return Command(vx_mps, vy_mps, vz_mps, command.yaw_rate_radps)


PILOTS: Mapping[str, type[Pilot]] = {
    "follow": Follow,
    "keep_apart": KeepApart,
    "formation": Formation,
}
"""Pilots of dmrl by name."""


def find_pilot(name: str) -> type[Pilot]:
    """Return the class of a pilot of dmrl or of another package.

    Raises
    ------
    SettingError
        If there is no pilot of this name.
    PluginError
        If it belongs to a plug-in that cannot be loaded.
    """
    if name in PILOTS:
        return PILOTS[name]
    plugins = entry_points.find_plugins(entry_points.PILOTS)
    if name not in plugins:
        known = ", ".join(sorted({*PILOTS, *plugins}))
        raise SettingError(f"no pilot {name}. Choose one of: {known}")
    loaded = plugins[name].load()
    fits = isinstance(loaded, type) and issubclass(loaded, Pilot)
    plugins[name].require(fits, "a subclass of dmrl.plugins.Pilot")
    return loaded  # type: ignore[no-any-return]


def naming_its_package(name: str) -> AbstractContextManager[None]:
    """Return a block in which errors of another package's pilot become a `PluginError`."""
    if name in PILOTS:
        return nullcontext()
    return entry_points.find_plugins(entry_points.PILOTS)[name].naming_the_package("failed")


def require_leader(name: str, leader: str) -> None:
    """Raise SettingError if a pilot of dmrl follows a leader and there is none.

    Raises
    ------
    SettingError
        If all robots are flown.
    """
    if not leader and name in ("follow", "formation"):
        raise SettingError(f"--pilot {name} flies all robots and has no leader. Add one: --robots")
