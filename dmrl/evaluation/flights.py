"""Evaluate flights over time: what an observer holds, sees, misses and finds again."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dmrl import topics
from dmrl.errors import RecordingError
from dmrl.estimation.tracking.detector_rates import DetectorRates
from dmrl.estimation.tracking.flight_metrics import (
    CONTACT_M,
    DEFINITIONS,
    PairFlight,
    compute_bands,
    compute_flight_figures,
)
from dmrl.evaluation.figure_tables import describe_source, format_values
from dmrl.evaluation.tracks import interpolate_truth, read_track_camera
from dmrl.geometry.frames import Array, pixels_from_horizontal
from dmrl.labelling.flight_log import OBSERVER_TOPICS, TRUTH_TOPICS, FlightLog, read_flight
from dmrl.labelling.ground_truth import find_true_path, list_true_pairs
from dmrl.labelling.observer_log import ObserverLog, read_observer_log
from dmrl.recording import read_summary

TITLE, EACH = "flight", "observer, peer"
RIGHT_PX = 16.0
"""Radius within which a detection is right, pixels, as for detections against labels."""


def has_flown(recording: Path) -> bool:
    """Return whether a pilot flew a robot in the recording, with true positions."""
    held = list(read_summary(recording).topics)
    flown = topics.list_robots(held, topics.COMMAND)
    return any(robot in flown for robot, _ in list_true_pairs(held))


def judge(recording: Path) -> list[PairFlight]:
    """Follow every pair of an observer and a peer through a flight.

    Observers are the robots that a pilot flies; without any, those with detections.

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has no such pair with true positions.
    """
    flight = read_flight(recording, *OBSERVER_TOPICS, *TRUTH_TOPICS)
    held = list(flight.topics)
    observers = topics.list_robots(held, topics.COMMAND) or sorted(flight.detections)
    pairs = [pair for pair in list_true_pairs(held) if pair[0] in observers]
    if not pairs:
        raise RecordingError(
            f"{recording} has no true position of a peer of a robot with commands or detections. "
            "Use a simulated flight, or one with motion capture"
        )
    found = []
    for robot in sorted({robot for robot, _ in pairs}):
        found += _follow_peers(flight, robot, [peer for own, peer in pairs if own == robot])
    return found


def _follow_peers(flight: FlightLog, robot: str, peers: list[str]) -> list[PairFlight]:
    """Return the flights of one observer; without detections they have no images."""
    paths = [find_true_path(flight, robot, peer) for peer in peers]
    if robot not in flight.detections:
        none, no = np.zeros(0), np.zeros(0, bool)
        return [
            PairFlight(robot, peer, (at - at[0]) * 1e-9, xyz, none, none, none, no, no, no, none)
            for peer, (at, xyz) in zip(peers, paths, strict=True)
        ]
    sight = read_observer_log(flight, robot, read_track_camera(flight, robot), 0.0)
    truth, shown = interpolate_truth(flight, sight, peers)
    threshold = flight.detections[robot].threshold
    floor = DetectorRates(**(flight.detections[robot].rates or {})).min_confidence
    right, false = _match_detections(sight, truth, shown, threshold)
    weak, _ = _match_detections(sight, truth, shown, np.full(len(threshold), floor))
    image_s = (sight.time_ns - sight.time_ns[0]) * 1e-9
    turn = np.abs(np.gradient(sight.yaw_rad, image_s)) if len(image_s) > 1 else np.zeros(1)
    found = []
    for j, (peer, (at, xyz)) in enumerate(zip(peers, paths, strict=True)):
        distance_m = np.linalg.norm(truth[j], axis=1)
        seen = (image_s, distance_m, turn, shown[j], right[j], weak[j], false)
        found.append(PairFlight(robot, peer, (at - at[0]) * 1e-9, xyz, *seen))
    return found


def _match_detections(
    sight: ObserverLog, truth: Array, shown: NDArray[np.bool_], threshold: Array
) -> tuple[NDArray[np.bool_], Array]:
    """Return (J, K) whether peers are detected, and (K,) detections of nobody, at a threshold."""
    count = np.diff(sight.first_row)
    image = np.repeat(np.arange(len(count)), count)
    sure = sight.detections[:, 4] >= threshold[image]
    image, uv = image[sure], sight.detections[sure, :2]
    roll, pitch = sight.attitude_rad.T
    right, mine = np.zeros(shown.shape, bool), np.zeros(len(image), bool)
    for j, place_m in enumerate(truth):
        at_px = pixels_from_horizontal(place_m, roll, pitch, sight.camera)[0][image]
        near = shown[j, image] & (np.linalg.norm(uv - at_px, axis=1) <= RIGHT_PX)
        right[j, image[near]] = True
        mine |= near
    return right, np.bincount(image[~mine], minlength=len(count)).astype(float)


def lasts_s(judged: list[PairFlight]) -> float:
    """Return the length of the longest flight, seconds."""
    return max(float(one.true_s[-1]) for one in judged)


def document(recording: Path, judged: list[PairFlight], settle_s: float) -> dict[str, Any]:
    """Return all figures as JSON values; null where a figure is undefined."""
    return {
        "recording": describe_source(recording),
        "flights": [
            {
                "robot": one.robot,
                "peer": one.peer,
                **compute_flight_figures(one),
                "bands": compute_bands(one),
            }
            for one in judged
        ],
        "definitions": DEFINITIONS,
    }


BAND_UNITS = {"distance_m": "m", "turn_radps": "rad/s"}
# Name of a figure, its words in the table, and its format.
COLUMNS = (
    ("held_s", "held, s", ".1f"),
    ("contacts", "contacts", ".0f"),
    ("recall", "recall", ".0%"),
    ("false_per_image", "false/image", ".3f"),
    ("silences", "silences", ".0f"),
    ("silence_s", "mean, s", ".2f"),
    ("longest_silence_s", "longest, s", ".1f"),
    ("find_again_s", "find again, s", ".2f"),
    ("longest_alarm_s", "longest alarm, s", ".1f"),
    ("loop_s", "loop, s", ".1f"),
)


def note(made: Mapping[str, Any]) -> str:
    """Describe the columns of the table, and list recall by distance and turn rate."""
    words = [
        f"held: until the peer is lost; contacts: nearer than {CONTACT_M:g} m; recall, false: at "
        "the detector's threshold; silences, mean, longest: in view, not detected; find again: "
        "from its return into view to its detection; alarm: images in a row with false detections; "
        "loop: time in view between silences that can end a closed loop"
    ]
    for one in made["flights"]:
        parts = [
            f"from {band['from']:g} {BAND_UNITS[band['by']]}: {band['recall']:.0%} of "
            f"{band['in_view']:.0f}"
            for band in one["bands"]
            if band["recall"] is not None
        ]
        if parts:
            words.append(f"{one['robot']}, {one['peer']}: recall in view {'; '.join(parts)}")
    return ".\n".join(words)


def rows(made: Mapping[str, Any]) -> list[list[str]]:
    """Return one row per pair of a ``document``."""
    return [
        [f"{one['robot']}, {one['peer']}", *format_values(one, COLUMNS)] for one in made["flights"]
    ]
