"""Pilots that ship with dmrl: follow, keep apart, formation.

They forgive what a small network misses. Between detections a pilot carries its leader on, by
the leader's last velocity and its own motion. The less certain that place is, the slower it flies;
when the leader is gone, it stops and turns to where the leader was heading.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dmrl import entry_points
from dmrl.errors import SettingError
from dmrl.flight.leader_belief import LeaderBelief
from dmrl.flight.onboard_pilot import Onboard
from dmrl.flight.pilot import Command, Observation, PeerTrack, Pilot, Task
from dmrl.geometry.frames import Array

GAIN_PER_S, CLIMB_GAIN_PER_S, TURN_GAIN_PER_S = 1.2, 0.8, 3.0
"""Speed by metre of a wrong distance, of a wrong height; turn rate by radian of bearing."""
TRUST_STD_M = 0.35
"""Standard deviation of the leader's position at which a pilot flies at half its speed: half the
default distance."""
RETREAT_MPS, SIGHT_M = 0.2, 0.8
"""Speed at which a pilot backs away from a leader that it does not see: from afar, the image shows
more of the floor. Beyond the second, where a small network seldom sees a drone, it comes closer."""
MISSED_S = 0.15
"""A leader that was not detected for so long before the last image is not seen."""
START_STD_M = 0.2
"""Standard deviation of the leader's place at the start, where it is ahead."""
NEAR_M = 0.45
"""Distance below which a pilot moves away from any peer."""


@dataclass(frozen=True, slots=True)
class Leader:
    """The leader as a pilot knows it, in its own horizontal frame now.

    Parameters
    ----------
    position_m, velocity_mps
        (3,) along the axes of the robot's horizontal frame.
    std_m
        Standard deviation of the position over the floor.
    bearing_rad
        Direction to look in.
    """

    position_m: Array
    velocity_mps: Array
    std_m: float
    bearing_rad: float


class Follow(Pilot):
    """Fly behind the leader, at the distance of the task and at its height."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        start = np.array([task.distance_m, 0.0])
        self._belief = LeaderBelief(start, np.zeros(2), START_STD_M**2 * np.eye(2))
        self._seen: PeerTrack | None = None
        self._height_m = 0.0
        self._last_s, self._last_image_s = 0.0, 0.0

    def command(self, seen: Observation) -> Command:
        """Return the command towards the place that `aim` gives."""
        leader = self.find_leader(seen)
        x, y, _ = leader.position_m
        trust = 1.0 / (1.0 + (leader.std_m / TRUST_STD_M) ** 2)
        to_go = self.aim(leader)
        wanted = trust * leader.velocity_mps[:2] + GAIN_PER_S * to_go[:2]
        towards = np.array([x, y]) / max(float(np.hypot(x, y)), 1e-6)
        # Flying at the leader needs to know where it is; flying away from it does not.
        wanted = wanted - (1.0 - trust) * max(float(wanted @ towards), 0.0) * towards
        too_far = self._seen is None and float(np.hypot(x, y)) > SIGHT_M
        back = -trust if too_far else 1.0 - trust
        wanted -= back * RETREAT_MPS * towards
        climb = trust * CLIMB_GAIN_PER_S * float(to_go[2])
        passing = leader.velocity_mps[:2] - seen.velocity_mps
        rate = (x * passing[1] - y * passing[0]) / max(x * x + y * y, NEAR_M**2)
        turn = TURN_GAIN_PER_S * leader.bearing_rad + trust * float(rate)
        return keep_apart(Command(float(wanted[0]), float(wanted[1]), climb, turn), seen.tracks)

    def aim(self, leader: Leader) -> Array:
        """Return the (3,) way to the wanted place, metres in the robot's horizontal frame."""
        x, y, z = leader.position_m
        distance = max(float(np.hypot(x, y)), 1e-6)
        short = (distance - self.task.distance_m) / distance
        return np.array([short * x, short * y, z])

    def find_leader(self, seen: Observation) -> Leader:
        """Return the leader as it is now: its track, or where it may be without one."""
        dt_s, self._last_s = seen.time_s - self._last_s, seen.time_s
        image_s = seen.time_s - seen.image_age_s
        is_new, self._last_image_s = image_s > self._last_image_s + 1e-6, image_s
        track = self._choose_track(seen)
        if track is not None and track.age_s - seen.image_age_s <= MISSED_S:
            self._seen, self._height_m = track, seen.height_m + float(track.position_m[2])
            std_m = float(np.sqrt(np.linalg.eigvalsh(track.covariance[:2, :2])[-1]))
            bearing = float(np.arctan2(track.position_m[1], track.position_m[0]))
            return Leader(track.position_m, track.velocity_mps, std_m, bearing)
        if self._seen is not None:
            last, self._seen = self._seen, None
            self._belief = LeaderBelief(
                last.position_m[:2], last.velocity_mps[:2], last.covariance[:2, :2]
            )
        self._belief.move(seen, dt_s)
        if is_new:
            self._belief.miss()
        place, velocity, std_m = self._belief.mean()
        rise = self._height_m - seen.height_m if self._height_m else 0.0
        bearing = self._belief.best_bearing()
        return Leader(np.array([*place, rise]), np.array([*velocity, 0.0]), std_m, bearing)

    def _choose_track(self, seen: Observation) -> PeerTrack | None:
        """Return the leader's track: the one with its name, or the likeliest without another's."""
        name = self.task.leader
        named = [track for track in seen.tracks if name and track.peer == name]
        unnamed = [track for track in seen.tracks if not track.peer or not name]
        place = self._belief.mean()[0] if self._seen is None else self._seen.position_m[:2]

        def misfit(track: PeerTrack) -> float:
            away = float(np.linalg.norm(track.position_m[:2] - place))
            return away + float(np.sqrt(np.trace(track.covariance)))

        return min(named or unnamed, key=misfit, default=None)


class KeepApart(Pilot):
    """Hover, and move away from every peer that comes near."""

    def command(self, seen: Observation) -> Command:
        """Return the command away from near peers."""
        return keep_apart(Command(), seen.tracks)


class Formation(Follow):
    """Keep a place beside the leader that does not turn with it, and look at the leader.

    The place is where the robot started: so robots that start around their leader stay apart
    without seeing each other.
    """

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self._turned_rad = 0.0
        self._side_rad: float | None = None

    def find_leader(self, seen: Observation) -> Leader:
        """Return the leader, and count how far the robot has turned."""
        self._turned_rad += seen.yaw_rate_radps * (seen.time_s - self._last_s)
        return super().find_leader(seen)

    def aim(self, leader: Leader) -> Array:
        """Return the way to the robot's place in the formation."""
        x, y, z = leader.position_m
        if self._side_rad is None:
            self._side_rad = float(np.arctan2(y, x)) + self._turned_rad
        side = self._side_rad - self._turned_rad
        away = self.task.distance_m * np.array([np.cos(side), np.sin(side)])
        high = FORMATION_STEP_M * (1 if self.task.number % 2 == 0 else -1)
        return np.array([x - away[0], y - away[1], z + high])


FORMATION_STEP_M = 0.2
"""Robots of a formation fly so far above and below their leader, in turn."""


def keep_apart(command: Command, tracks: tuple[PeerTrack, ...]) -> Command:
    """Return a command without its part towards near peers, and with one away from them."""
    wanted = np.array(command[:3])
    for track in tracks:
        distance = max(float(np.linalg.norm(track.position_m)), 1e-6)
        if distance < NEAR_M:
            towards = track.position_m / distance
            wanted -= (max(float(wanted @ towards), 0.0) + (NEAR_M - distance) * 2) * towards
    vx_mps, vy_mps, vz_mps = wanted.tolist()
    return Command(vx_mps, vy_mps, vz_mps, command.yaw_rate_radps)


PILOTS: Mapping[str, type[Pilot]] = {
    "follow": Follow,
    "keep_apart": KeepApart,
    "formation": Formation,
    "onboard": Onboard,
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
