"""Layout ``flight``: space, images, and plots of every pair of robots."""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from dmrl import topics
from dmrl.colours import RGB
from dmrl.terminal.progress import say
from dmrl.topics import Topic
from dmrl.viewer import layouts
from dmrl.viewer.content.flight_streamer import Follower
from dmrl.viewer.content.robot_motion import Motion, Names, glimpse
from dmrl.viewer.drawing import space, time_plots
from dmrl.viewer.drawing.entity import WORLD, Entity, camera_frame, horizontal_frame, optical_frame
from dmrl.viewer.layouts import Eye, Plot, Space
from dmrl.viewer.scene import Draw, Scene, eyes_of, firsts, model_draws, picture_draws
from dmrl.viewer.selection import MANY_PAIRS, Selection
from dmrl.viewer.settings import Settings

CAMERAS_MAX = 4
DISTANCE = "distance, m"
"""Title of the plot of estimated, true and measured distances."""


def scene(selection: Selection, settings: Settings) -> Scene:
    """Build the scene of a flight. A few samples of the recordings decide its panels."""
    pairs = _pairs(selection, settings.robot)
    seen = glimpse(selection.recordings, pairs, *selection.shown_ns)
    robots = _robots(selection, pairs, settings.robot)
    eyes = eyes_of(selection, sorted(selection.image_ns)[:CAMERAS_MAX], {})
    sources: dict[str, set[str]] = {eye.robot: set() for eye in eyes}
    named = {}
    draws: list[Draw] = []
    for eye in eyes:
        draws += picture_draws(eye, sources[eye.robot])
        if topics.detections(eye.robot) in _topics(selection):
            draws += model_draws(eye, {}, smooth=False)
            named["detection"] = RGB["detection"]
    for robot in robots:
        draws += _robot_draws(selection, seen, robot, own=robot == robots[0])
    for pair in pairs:
        draws += [_sensor_draw(row, *pair, own=False) for row in topics.PAIR_SENSORS]
    spaces = _spaces(selection, seen, pairs, robots, eyes)
    panels = {f"{a} sees {b}": _panels(selection, seen, (a, b)) for a, b in pairs}
    if not pairs:
        panels = {robots[0]: _own_panels(selection, robots)} if robots else {}
    return Scene(
        layouts.flight(spaces, eyes, panels),
        draws,
        [(None, entity) for entity in _stills(selection, seen, robots)],
        eyes,
        sources,
        named,
        partial(Follower, pairs, seen, selection.shown_ns[0]),
    )


def _topics(selection: Selection) -> set[str]:
    return {
        topic
        for kept in selection.recordings.values()
        for topic, info in kept.topics.items()
        if info.count
    }


def _pairs(selection: Selection, robot: str | None) -> list[Names]:
    pairs = selection.pairs(robot)
    if robot is not None or len(pairs) <= MANY_PAIRS:
        return pairs
    first = min(selection.image_ns, default=pairs[0][0])
    say(f"{len(pairs)} pairs of robots: showing those of {first}. Choose another with --robot")
    return selection.pairs(first)


def _robots(selection: Selection, pairs: Sequence[Names], only: str | None) -> list[str]:
    """Return the robots that are drawn: those of the pairs, and those with sensors of their own."""
    own = {n["robot"] for row in topics.OWN_SENSORS for n in selection.found(row.pattern)}
    own |= {n["robot"] for n in selection.found(topics.TRACKS)} | set(selection.image_ns)
    if only is not None or pairs:
        own &= {name for pair in pairs for name in pair} | {only or pairs[0][0]}
    return sorted(own | {name for pair in pairs for name in pair})


def _robot_draws(selection: Selection, motion: Motion, robot: str, *, own: bool) -> list[Draw]:
    attitude = topics.attitude(robot)
    draws = [
        Draw(attitude, time_plots.Attitude(attitude, robot, own).draw),
        *(_sensor_draw(row, robot, own=own) for row in topics.OWN_SENSORS),
        Draw(topics.tracks(robot), partial(space.tracks, topics.tracks(robot), robot)),
    ]
    if camera_frame(robot) not in motion.poses:
        draws.append(Draw(attitude, partial(space.attitude, robot)))
    return draws


def _sensor_draw(row: Topic, robot: str, peer: str = "", *, own: bool) -> Draw:
    topic = row.pattern.format(robot=robot, peer=peer)
    return Draw(topic, partial(time_plots.sensor, topic, row=row, robot=robot, own=own))


def _stills(selection: Selection, seen: Motion, robots: Sequence[str]) -> Iterator[Entity]:
    """Yield the bodies of robots, and the fixed frames below those of /tf."""
    present = _topics(selection)
    calibrations = firsts(selection, map(topics.calibration, robots))
    for robot in robots:
        if camera_frame(robot) not in seen.poses and topics.attitude(robot) not in present:
            yield space.still_frame(camera_frame(robot), horizontal_frame(robot))
        if optical_frame(robot) not in seen.poses:
            yield space.still_frame(optical_frame(robot), camera_frame(robot), space.OPTICAL_XYZW)
        yield from space.body(robot)
        topic = topics.calibration(robot)
        # All zeros: not calibrated. Not nine values: no camera.
        k = calibrations[topic]["K"] if topic in calibrations else ()
        if len(k) == 9 and any(k):
            yield space.frustum(robot, topic, calibrations[topic])


def _spaces(
    selection: Selection,
    motion: Motion,
    pairs: Sequence[Names],
    robots: Sequence[str],
    eyes: Sequence[Eye],
) -> list[Space]:
    """Return a view of the world, or of each observer's horizontal frame if there is no world."""
    groups: dict[str, list[str]] = {}
    for robot in robots:
        groups.setdefault(motion.space(robot), []).append(robot)
    lookers = {pair[0] for pair in pairs} | {eye.robot for eye in eyes}
    return [
        _space(motion, frame, [p for p in pairs if p[0] in members], members, eyes)
        for frame, members in groups.items()
        if frame == WORLD or lookers & set(members) or len(groups) == 1
    ]


def _space(
    motion: Motion, frame: str, pairs: Sequence[Names], robots: Sequence[str], eyes: Sequence[Eye]
) -> Space:
    contents, trails = [], []
    for robot in robots:
        contents += [f"/{robot}/body", f"/{robot}/name", topics.calibration(robot)]
        contents += [topics.tracks(robot), *_below(topics.tracks(robot), "velocity", "covariance")]
    contents += [eye.picture for eye in eyes if eye.robot in robots]
    for pair in pairs:
        contents += _below(topics.uwb_range(*pair), "line", "sphere")
        for path in (topics.position(*pair), topics.truth(*pair)):
            contents += [path, *_below(path, "covariance", "trail")]
            trails.append(f"{path}/trail")
    low, high = _extent(motion, frame, pairs, robots)
    middle, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 1.2)
    eye = middle + size * np.array([-0.45, -0.5, 0.45])
    return Space(frame, tuple(contents), tuple(trails), _three(eye), _three(middle))


def _below(path: str, *names: str) -> list[str]:
    return [f"{path}/{name}" for name in names]


def _three(point: np.ndarray) -> tuple[float, float, float]:
    x, y, z = point.tolist()
    return x, y, z


def _extent(
    motion: Motion, frame: str, pairs: Sequence[Names], robots: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box of nearly all positions and their observers, metres."""
    if frame == WORLD:
        own = (horizontal_frame(robot) for robot in robots)
        found = [motion.poses[name].xyz for name in own if name in motion.poses]
        return _nearly_all(found)
    every = (motion.truths.get(pair) or motion.estimates.get(pair) for pair in pairs)
    low, high = _nearly_all([p.xyz for p in every if p is not None])
    return np.minimum(low, 0.0), np.maximum(high, 0.0)


def _nearly_all(parts: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([*parts] or [np.zeros((1, 3))])
    return np.percentile(points, 2, axis=0), np.percentile(points, 98, axis=0)


def _panels(selection: Selection, motion: Motion, pair: Names) -> list[Plot]:
    """Return the plots of one pair of robots that have data."""
    peer = pair[1]
    estimate, truth = topics.position(*pair), topics.truth(*pair)
    judged = pair in motion.estimates and pair in motion.truths
    curves = _curves(selection, topics.PAIR_SENSORS, [pair])
    for path, has in ((truth, motion.truths), (estimate, motion.estimates)):
        if pair in has:
            curves.setdefault(DISTANCE, []).append(f"{path}/distance")
    panels = [
        Plot(f" of {peer}, ".join(title.split(", ", 1)), tuple(lines))
        for title, lines in curves.items()
    ]
    if judged:
        panels += [
            Plot(
                f"error along {axis}, m",
                (f"{estimate}/bound/{axis}", f"{estimate}/error/{axis}"),
                (-1.2, 1.2),
            )
            for axis in "xy"
        ]
        panels.append(
            Plot("NEES of x and y, 2 dof", (f"{estimate}/nees", f"{estimate}/nees/limit"), (0, 15))
        )
    if pair in motion.estimates:
        bands = tuple(f"{topics.position(*other)}/status" for other in motion.estimates)
        panels.append(Plot("status of positions", bands, band=True))
    return [*panels, *_own_panels(selection, pair)]


def _curves(
    selection: Selection, rows: Sequence[Topic], pairs: Sequence[Names]
) -> dict[str, list[str]]:
    """Return the lines of sensors that have data, by the title of their panel."""
    present, found = _topics(selection), dict[str, list[str]]()
    for row in rows:
        for robot, peer in pairs:
            topic = row.pattern.format(robot=robot, peer=peer)
            if row.curve is not None and topic in present:
                found.setdefault(row.curve.title, []).extend(row.curve.lines(topic))
    return found


def _own_panels(selection: Selection, robots: Sequence[str]) -> list[Plot]:
    present = _topics(selection)
    tilted = [t for r in robots if (t := topics.attitude(r)) in present]
    curves = _curves(selection, topics.OWN_SENSORS, [(robot, "") for robot in robots])
    panels = [Plot(title, tuple(lines)) for title, lines in curves.items()]
    if tilted:
        own = tilted[0]
        name = f"attitude of {(topics.names(topics.ATTITUDE, own) or {})['robot']}, degrees"
        panels.append(Plot(name, (f"{own}/roll", f"{own}/pitch")))
        panels.append(Plot("yaw, degrees", tuple(f"{topic}/yaw" for topic in tilted)))
    return panels
