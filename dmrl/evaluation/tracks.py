"""Evaluate the tracks of a recording against true positions, beside the detections alone."""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import RecordingError
from dmrl.estimation.model.position_metrics import is_covered_by_truth
from dmrl.estimation.tracking.track_metrics import (
    DEFINITIONS,
    MAX_MATCH_M,
    EvaluatedTracks,
    compute_figures,
    match_positions,
)
from dmrl.evaluation.figure_tables import describe_source, format_values
from dmrl.geometry.camera_file import parse_camera
from dmrl.geometry.frames import (
    Array,
    Camera,
    horizontal_from_pixels,
    is_inside,
    pixels_from_horizontal,
)
from dmrl.labelling.flight_log import OBSERVER_TOPICS, TRUTH_TOPICS, FlightLog, read_flight
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.labelling.observer_log import ObserverLog, read_observer_log
from dmrl.labelling.recorded_camera import require_camera
from dmrl.recording import read_summary

TITLE, EACH = "tracks against truth", "observer"
CAMERAS_METADATA = "dmrl.cameras"
"""Metadata record of a recording with tracks: the tracker's camera of each robot, as TOML."""


def has_tracks_and_truth(recording: Path) -> bool:
    """Return whether a recording has tracks and true positions of their peers."""
    held = list(read_summary(recording).topics)
    return any(_find_peers(held, robot) for robot in topics.list_robots(held, topics.TRACKS))


def _find_peers(held: list[str], robot: str) -> list[str]:
    return [peer for observer, peer in list_true_pairs(held) if observer == robot]


def judge(recording: Path) -> list[EvaluatedTracks]:
    """Evaluate every observer with tracks and true positions.

    Parameters
    ----------
    recording
        Recording with ``/<robot>/tracks``, their inputs, and the truth; see
        `labelling.ground_truth`.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has no robot with both.
    """
    flight = read_flight(recording, *OBSERVER_TOPICS, topics.TRACKS, *TRUTH_TOPICS)
    if not flight.tracks:
        raise RecordingError(f"{recording} has no tracks. Try: dmrl track {recording} OUT.mcap")
    held = list(flight.topics)
    judged = [
        _evaluate_observer(flight, robot, peers)
        for robot in sorted(flight.tracks)
        if (peers := _find_peers(held, robot))
    ]
    if not judged:
        raise RecordingError(
            f"{recording} has no true position of any peer. Use a simulated flight, or one with "
            "motion capture"
        )
    return judged


def read_track_camera(held: FlightLog, robot: str) -> Camera:
    """Return the camera of the tracks; mount, delay and lens may differ from the recording's."""
    used = held.metadata.get(CAMERAS_METADATA, [{}])[-1].get(robot)
    return require_camera(held, robot, parse_camera(used, held.path) if used else None)


class _PeerRow(NamedTuple):
    """One peer in view of one image; see `Judged`."""

    image: int
    peer: str
    named: str
    error_m: Array
    single_error_m: Array
    covariance: Array


def _evaluate_observer(held: FlightLog, robot: str, peers: list[str]) -> EvaluatedTracks:
    """Tracks of one observer. A track is false if for most of its life it is at no peer.

    The life of a track is counted in images. In an image, a track is astray if it is near no peer.
    """
    sight = read_observer_log(held, robot, read_track_camera(held, robot), 0.0)
    truth, shown = interpolate_truth(held, sight, peers)
    rows: list[_PeerRow] = []
    lived: Counter[int] = Counter()
    astray: Counter[int] = Counter()
    for k, tracks in _iter_image_tracks(held, sight):
        rows += _build_rows(sight, k, tracks, truth[:, k], dict(enumerate(peers)), shown[:, k])
        lived.update(t.id for t in tracks)
        at_peers = set(match_positions(truth[:, k], _track_positions(tracks), MAX_MATCH_M).tolist())
        astray.update(t.id for i, t in enumerate(tracks) if i not in at_peers)
    false_tracks = sum(2 * astray[number] > lived[number] for number in lived)
    return _collect_rows(sight, rows, false_tracks)


def _iter_image_tracks(held: FlightLog, sight: ObserverLog) -> Iterator[tuple[int, list[Any]]]:
    """Yield the number of an image and its tracks; times without an image are left out."""
    number = {int(time_ns): k for k, time_ns in enumerate(sight.log_time_ns)}
    for stamped in held.tracks[sight.robot]:
        if (k := number.get(stamped.time_ns)) is not None:
            yield k, list(stamped.message.tracks)


def _collect_rows(sight: ObserverLog, rows: list[_PeerRow], false_tracks: int) -> EvaluatedTracks:
    """Rows as columns."""
    time_s = (sight.time_ns - sight.time_ns[:1]) * 1e-9
    return EvaluatedTracks(
        sight.robot,
        np.asarray(time_s[np.array([row.image for row in rows], int)], float),
        [row.peer for row in rows],
        [row.named for row in rows],
        np.reshape([row.error_m for row in rows], (-1, 3)),
        np.reshape([row.single_error_m for row in rows], (-1, 3)),
        np.reshape([row.covariance for row in rows], (-1, 3, 3)),
        false_tracks,
        float(time_s[-1]) if len(time_s) else 0.0,
    )


def _build_rows(
    sight: ObserverLog,
    k: int,
    tracks: list[Any],
    truth_m: Array,
    peers: Mapping[int, str],
    shown: NDArray[np.bool_],
) -> list[_PeerRow]:
    """Return the peers in view of image k, with their tracks and detections."""
    seen = np.flatnonzero(shown)
    view = sight.view(k)
    uv, depth_m = view.uv[: len(seen)], view.depth_m[: len(seen)]
    roll, pitch = (np.full(len(uv), angle) for angle in (view.roll_rad, view.pitch_rad))
    single = horizontal_from_pixels(uv, depth_m, roll, pitch, sight.camera)
    found = _track_positions(tracks)
    rows = []
    pairs = zip(
        match_positions(truth_m[seen], found), match_positions(truth_m[seen], single), strict=True
    )
    for j, (mine, own) in zip(seen.tolist(), pairs, strict=True):
        nothing = np.full(3, np.nan)
        rows.append(
            _PeerRow(
                k,
                peers[j],
                tracks[mine].peer if mine >= 0 else "",
                found[mine] - truth_m[j] if mine >= 0 else nothing,
                single[own] - truth_m[j] if own >= 0 else nothing,
                np.array(tracks[mine].covariance if mine >= 0 else [np.nan] * 9),
            )
        )
    return rows


def _track_positions(tracks: list[Any]) -> Array:
    """Return the positions of Track messages, (D, 3), metres."""
    return np.array([[t.x, t.y, t.z] for t in tracks]).reshape(-1, 3)


def interpolate_truth(
    held: FlightLog, sight: ObserverLog, peers: list[str]
) -> tuple[Array, NDArray[np.bool_]]:
    """(J, K, 3) true positions at the images, NaN where unknown; (J, K) whether in the image."""
    xyz = np.full((len(peers), len(sight.time_ns), 3), np.nan)
    shown = np.zeros(xyz.shape[:2], bool)
    for j, peer in enumerate(peers):
        true_ns, true_m = find_true_path(held, sight.robot, peer)
        known = is_covered_by_truth(sight.time_ns, true_ns)
        at = sight.time_ns[known]
        xyz[j, known] = np.column_stack([np.interp(at, true_ns, axis) for axis in true_m.T])
        roll, pitch = sight.attitude_rad.T
        uv, depth_m, _ = pixels_from_horizontal(xyz[j], roll, pitch, sight.camera)
        shown[j] = is_inside(uv, sight.camera.width_px, sight.camera.height_px) & (depth_m > 0)
    return xyz, shown


def lasts_s(judged: list[EvaluatedTracks]) -> float:
    """Return the time from the first to the last image of the longest observer, seconds."""
    return max(one.length_s for one in judged)


def document(recording: Path, judged: list[EvaluatedTracks], settle_s: float) -> dict[str, Any]:
    """Return all metrics as JSON values; null where a metric is undefined."""
    return {
        "recording": describe_source(recording),
        "settle_s": settle_s,
        "robots": [{"robot": one.robot, **compute_figures(one, settle_s)} for one in judged],
        "definitions": DEFINITIONS,
    }


# Name of a figure, its words in the table, and its format.
COLUMNS = (
    ("in_view", "in view", ".0f"),
    ("rmse_m", "RMSE, m", ".3f"),
    ("single_rmse_m", "of images, m", ".3f"),
    ("reduction", "less by", ".0%"),
    ("median_m", "median, m", ".3f"),
    ("single_median_m", "of images, m", ".3f"),
    ("coverage_95", "in 95 %", ".0%"),
    ("followed", "followed", ".0%"),
    ("detected", "detected", ".0%"),
    ("false_tracks_per_min", "false/min", ".1f"),
    ("named_right", "named right", ".0%"),
)


def note(made: Mapping[str, Any]) -> str:
    """Describe the columns of the table of a ``document``."""
    return (
        "3D errors of the peers in view; of images: errors of the detections in single images; "
        "less by: by how much less the RMSE of the tracks is; in 95 %: inside the 95 % ellipsoid; "
        f"followed, detected: share of peers with a track, a detection within {MAX_MATCH_M:g} m; "
        "false: tracks near no peer; named right: tracks with their peer's name; before "
        f"{made['settle_s']:g} s, while tracks settle, only false counts"
    )


def rows(made: Mapping[str, Any]) -> list[list[str]]:
    """Return one row per observer of a ``document``."""
    return [[one["robot"], *format_values(one, COLUMNS)] for one in made["robots"]]
