"""Layout ``flight``: space, images, and plots of every pair of robots."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from dmrl import topics
from dmrl.colours import RGB
from dmrl.terminal.progress import say
from dmrl.topics import Topic
from dmrl.viewer import layouts
from dmrl.viewer.content.causes import draw_causes, list_cause_panels
from dmrl.viewer.content.flight_streamer import FlightStreamer
from dmrl.viewer.content.robot_motion import FlightMotion, Names, sample_motion
from dmrl.viewer.drawing import archetypes, space, time_plots
from dmrl.viewer.drawing.entity import (
    WORLD_FRAME,
    Entity,
    camera_frame,
    horizontal_frame,
    optical_frame,
)
from dmrl.viewer.layouts import CameraPanel, PlotPanel, SpacePanel
from dmrl.viewer.scene import (
    DrawRule,
    Scene,
    build_camera_panels,
    build_colour_bars,
    build_image_rules,
    build_model_rules,
    load_first_messages,
)
from dmrl.viewer.selection import MAX_PAIRS, Selection
from dmrl.viewer.settings import Settings

MAX_CAMERAS = 4
DISTANCE_TITLE = "distance, m"
"""Title of the plot of estimated, true and measured distances."""


def scene(selection: Selection, settings: Settings) -> Scene:
    """Build the scene of a flight. A few samples of the recordings decide its panels."""
    pairs = _choose_pairs(selection, settings.robot)
    seen = sample_motion(selection.recordings, pairs, *selection.shown_ns)
    robots = _choose_robots(selection, pairs, settings.robot)
    piloted = {n["robot"] for n in selection.find_names(topics.COMMAND)}
    scales = archetypes.build_scales(settings.depth_max_m) if piloted else {}
    cameras = build_camera_panels(selection, sorted(selection.image_ns)[:MAX_CAMERAS], scales)
    sources: dict[str, set[str]] = {camera.robot: set() for camera in cameras}
    modelled = [c for c in cameras if topics.DETECTIONS(c.robot) in selection.topics]
    draws: list[DrawRule] = []
    for camera in cameras:
        draws += build_image_rules(camera, sources[camera.robot])
        if camera in modelled:
            draws += build_model_rules(camera, scales, smooth=False)
    for robot in robots:
        draws += _build_robot_rules(selection, seen, robot, own=robot == robots[0])
    for topic in map(topics.DETECTIONS, sorted(piloted)):
        draws.append(DrawRule(topic, partial(time_plots.draw_sight, topic)))
    for pair in pairs:
        draws += [_build_sensor_rule(row, *pair, own=False) for row in topics.PAIR_SENSORS]
    spaces = _build_spaces(selection, seen, pairs, robots, cameras)
    read = load_first_messages(selection, [topics.CAUSES(*pair) for pair in pairs])
    causes = {pair: read[topic] for pair in pairs if (topic := topics.CAUSES(*pair)) in read}
    panels = _build_panels(selection, seen, pairs, robots, causes)
    return Scene(
        layouts.build_flight_layout(spaces, cameras, panels, scales),
        draws,
        [
            *((None, entity) for entity in _iter_static_entities(selection, seen, robots)),
            *(bar for camera in cameras if scales for bar in build_colour_bars(camera, scales)),
            *(drawn for pair, message in causes.items() for drawn in draw_causes(pair, message)),
        ],
        cameras,
        sources,
        {"detection": RGB["detection"]} if modelled else {},
        partial(FlightStreamer, pairs, seen, selection.shown_ns[0]),
    )


def _build_panels(
    selection: Selection,
    seen: FlightMotion,
    pairs: Sequence[Names],
    robots: Sequence[str],
    causes: Mapping[Names, Mapping[str, Any]],
) -> dict[str, list[PlotPanel]]:
    """Return the plots of each pair, or of the robots' sensors where there is no pair."""
    if not pairs:
        return {robots[0]: _build_sensor_plots(selection, robots)} if robots else {}
    return {
        f"{a} sees {b}": [
            *_build_pair_plots(selection, seen, (a, b)),
            *(list_cause_panels((a, b), causes[a, b]) if (a, b) in causes else ()),
        ]
        for a, b in pairs
    }


def _choose_pairs(selection: Selection, robot: str | None) -> list[Names]:
    pairs = selection.find_pairs(robot)
    if robot is not None or len(pairs) <= MAX_PAIRS:
        return pairs
    first = min(selection.image_ns, default=pairs[0][0])
    say(f"{len(pairs)} pairs of robots: showing those of {first}. Choose another with --robot")
    return selection.find_pairs(first)


def _choose_robots(selection: Selection, pairs: Sequence[Names], only: str | None) -> list[str]:
    """Return the robots that are drawn: those of the pairs, and those with sensors of their own."""
    own = {n["robot"] for row in topics.OWN_SENSORS for n in selection.find_names(row.pattern)}
    own |= {n["robot"] for n in selection.find_names(topics.TRACKS)} | set(selection.image_ns)
    if only is not None or pairs:
        own &= {name for pair in pairs for name in pair} | {only or pairs[0][0]}
    return sorted(own | {name for pair in pairs for name in pair})


def _build_robot_rules(
    selection: Selection, motion: FlightMotion, robot: str, *, own: bool
) -> list[DrawRule]:
    attitude = topics.ATTITUDE(robot)
    draws = [
        DrawRule(attitude, time_plots.AttitudePlot(attitude, robot, own).draw_rows),
        *(_build_sensor_rule(row, robot, own=own) for row in topics.OWN_CURVES),
        DrawRule(topics.TRACKS(robot), partial(space.draw_tracks, topics.TRACKS(robot), robot)),
    ]
    if camera_frame(robot) not in motion.poses:
        draws.append(DrawRule(attitude, partial(space.draw_attitude, robot)))
    return draws


def _build_sensor_rule(row: Topic, robot: str, peer: str = "", *, own: bool) -> DrawRule:
    topic = row.pattern.format(robot=robot, peer=peer)
    return DrawRule(topic, partial(time_plots.draw_sensor, topic, row=row, robot=robot, own=own))


def _iter_static_entities(
    selection: Selection, seen: FlightMotion, robots: Sequence[str]
) -> Iterator[Entity]:
    """Yield the bodies of robots, and the fixed frames below those of /tf."""
    present = selection.topics
    calibrations = load_first_messages(selection, map(topics.CALIBRATION, robots))
    for robot in robots:
        if camera_frame(robot) not in seen.poses and topics.ATTITUDE(robot) not in present:
            yield space.build_fixed_frame(camera_frame(robot), horizontal_frame(robot))
        if optical_frame(robot) not in seen.poses:
            yield space.build_fixed_frame(
                optical_frame(robot), camera_frame(robot), space.OPTICAL_XYZW
            )
        yield from space.draw_body(robot)
        topic = topics.CALIBRATION(robot)
        # All zeros: not calibrated. Not nine values: no camera.
        k = calibrations[topic]["K"] if topic in calibrations else ()
        if len(k) == 9 and any(k):
            yield space.draw_frustum(robot, topic, calibrations[topic])


def _build_spaces(
    selection: Selection,
    motion: FlightMotion,
    pairs: Sequence[Names],
    robots: Sequence[str],
    cameras: Sequence[CameraPanel],
) -> list[SpacePanel]:
    """Return a view of the world, or of each observer's horizontal frame if there is no world."""
    groups: dict[str, list[str]] = {}
    for robot in robots:
        groups.setdefault(motion.display_frame(robot), []).append(robot)
    lookers = {pair[0] for pair in pairs} | {camera.robot for camera in cameras}
    return [
        _build_space(motion, frame, [p for p in pairs if p[0] in members], members, cameras)
        for frame, members in groups.items()
        if frame == WORLD_FRAME or lookers & set(members) or len(groups) == 1
    ]


def _build_space(
    motion: FlightMotion,
    frame: str,
    pairs: Sequence[Names],
    robots: Sequence[str],
    cameras: Sequence[CameraPanel],
) -> SpacePanel:
    contents, trails = [], []
    for robot in robots:
        contents += [f"/{robot}/body", f"/{robot}/name", topics.CALIBRATION(robot)]
        contents += [
            topics.TRACKS(robot),
            *_child_paths(topics.TRACKS(robot), "velocity", "covariance"),
        ]
    contents += [camera.picture for camera in cameras if camera.robot in robots]
    for pair in pairs:
        contents += _child_paths(topics.RANGE(*pair), "line", "sphere")
        for path in (topics.POSITION(*pair), topics.TRUTH(*pair)):
            contents += [path, *_child_paths(path, "covariance", "trail")]
            trails.append(f"{path}/trail")
    low, high = _find_extent(motion, frame, pairs, robots)
    middle, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 1.2)
    camera = middle + size * np.array([-0.45, -0.5, 0.45])
    return SpacePanel(frame, tuple(contents), tuple(trails), _to_tuple(camera), _to_tuple(middle))


def _child_paths(path: str, *names: str) -> list[str]:
    return [f"{path}/{name}" for name in names]


def _to_tuple(point: np.ndarray) -> tuple[float, float, float]:
    x, y, z = point.tolist()
    return x, y, z


def _find_extent(
    motion: FlightMotion, frame: str, pairs: Sequence[Names], robots: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box of nearly all positions and their observers, metres."""
    if frame == WORLD_FRAME:
        own = (horizontal_frame(robot) for robot in robots)
        found = [motion.poses[name].xyz for name in own if name in motion.poses]
        return _percentile_box(found)
    every = (motion.truths.get(pair) or motion.estimates.get(pair) for pair in pairs)
    low, high = _percentile_box([p.xyz for p in every if p is not None])
    return np.minimum(low, 0.0), np.maximum(high, 0.0)


def _percentile_box(parts: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([*parts] or [np.zeros((1, 3))])
    return np.percentile(points, 2, axis=0), np.percentile(points, 98, axis=0)


def _build_pair_plots(selection: Selection, motion: FlightMotion, pair: Names) -> list[PlotPanel]:
    """Return the plots of one pair of robots that have data."""
    peer = pair[1]
    estimate, truth = topics.POSITION(*pair), topics.TRUTH(*pair)
    judged = pair in motion.estimates and pair in motion.truths
    curves = _collect_curves(selection, topics.PAIR_SENSORS, [pair])
    for path, has in ((truth, motion.truths), (estimate, motion.estimates)):
        if pair in has:
            curves.setdefault(DISTANCE_TITLE, []).append(f"{path}/distance")
    panels = [
        PlotPanel(f" of {peer}, ".join(title.split(", ", 1)), tuple(lines))
        for title, lines in curves.items()
    ]
    if judged:
        panels += [
            PlotPanel(
                f"error along {axis}, m",
                (f"{estimate}/bound/{axis}", f"{estimate}/error/{axis}"),
                (-1.2, 1.2),
            )
            for axis in "xy"
        ]
        panels.append(
            PlotPanel(
                "NEES of x and y, 2 dof", (f"{estimate}/nees", f"{estimate}/nees/limit"), (0, 15)
            )
        )
    if pair in motion.estimates:
        bands = tuple(f"{topics.POSITION(*other)}/status" for other in motion.estimates)
        panels.append(PlotPanel("status of positions", bands, band=True))
    return [*panels, *_build_sensor_plots(selection, pair)]


def _collect_curves(
    selection: Selection, rows: Sequence[Topic], pairs: Sequence[Names]
) -> dict[str, list[str]]:
    """Return the lines of sensors that have data, by the title of their panel."""
    present, found = selection.topics, dict[str, list[str]]()
    for row in rows:
        for robot, peer in pairs:
            topic = row.pattern.format(robot=robot, peer=peer)
            if row.curve is not None and topic in present:
                found.setdefault(row.curve.title, []).extend(row.curve.list_lines(topic))
    return found


def _build_sensor_plots(selection: Selection, robots: Sequence[str]) -> list[PlotPanel]:
    present = selection.topics
    tilted = [t for r in robots if (t := topics.ATTITUDE(r)) in present]
    curves = _collect_curves(selection, topics.OWN_CURVES, [(robot, "") for robot in robots])
    panels = [PlotPanel(title, tuple(lines)) for title, lines in curves.items()]
    piloted = [robot for robot in robots if topics.COMMAND(robot) in present]
    sights = [t for robot in piloted if (t := topics.DETECTIONS(robot)) in present]
    if sights:
        bands = tuple(f"{topic}/sight" for topic in sights)
        panels.insert(0, PlotPanel("detections, per image", bands, band=True))
    if tilted:
        own = tilted[0]
        name = f"attitude of {(topics.parse_topic(topics.ATTITUDE, own) or {})['robot']}, degrees"
        panels.append(PlotPanel(name, (f"{own}/roll", f"{own}/pitch")))
        panels.append(PlotPanel("yaw, degrees", tuple(f"{topic}/yaw" for topic in tilted)))
    return panels
