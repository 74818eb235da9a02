"""Metrics of peers in view, lost contacts and detection gaps of a flight."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.tracking.flight_metrics import (
    LOST_RAD,
    PairFlight,
    compute_bands,
    compute_flight_figures,
    find_stretches,
)

TRUE_S = np.arange(0, 20.001, 0.05)
IMAGES = 200
IMAGE_S = 0.1 * np.arange(IMAGES)


def build_flight(**changes: np.ndarray) -> PairFlight:
    """Return a flight of 20 s with the peer 0.8 m ahead and detected in every image."""
    yes, no = np.ones(IMAGES, bool), np.zeros(IMAGES)
    ahead = np.tile([0.8, 0.0, 0.0], (len(TRUE_S), 1))
    plain = PairFlight(
        "cf1", "cf2", TRUE_S, ahead, IMAGE_S, np.full(IMAGES, 0.8), no, yes, yes, yes, no
    )
    return replace(plain, **changes)


def build_path(start_s: float, end_s: float, xyz: list[float]) -> np.ndarray:
    """Return the true path of the flight with another position between two times."""
    out = build_flight().true_m.copy()
    out[(start_s <= TRUE_S) & (end_s > TRUE_S)] = xyz
    return out


def build_mask(*spans: tuple[int, int]) -> np.ndarray:
    """Return a mask of images that is False in these index spans."""
    out = np.ones(IMAGES, bool)
    for first, end in spans:
        out[first:end] = False
    return out


def test_spans_of_true_values_are_found() -> None:
    found = find_stretches(np.array([True, False, True, True, False, True]))
    assert found.tolist() == [[0, 1], [2, 4], [5, 6]]
    assert not len(find_stretches(np.zeros(3, bool)))


@pytest.mark.parametrize(
    ("end_s", "xyz", "held_s"),
    [
        (7.9, [3.1, 0.0, 0.0], 20.0),  # less than three seconds
        (8.2, [3.1, 0.0, 0.0], 5.0),
        (8.2, [2.9, 0.0, 0.0], 20.0),
        (8.2, [0.8, 0.8 * math.tan(LOST_RAD + 0.01), 0.0], 5.0),
        (8.2, [0.8, 0.0, -0.8 * math.tan(LOST_RAD - 0.01)], 20.0),
        (8.2, [-0.8, 0.0, 0.0], 5.0),
    ],
)
def test_peer_is_lost_after_three_seconds_far_away_or_off_axis(
    end_s: float, xyz: list[float], held_s: float
) -> None:
    figures = compute_flight_figures(build_flight(true_m=build_path(5.0, end_s, xyz)))
    assert figures["held_s"] == pytest.approx(held_s)
    assert figures["held_to_end"] == (held_s == 20.0)


def test_each_contact_is_counted_once() -> None:
    path = build_path(3.0, 3.5, [0.19, 0.0, 0.0])
    path[TRUE_S > 19.5] = 0.0, 0.1, 0.1
    figures = compute_flight_figures(build_flight(true_m=path))
    assert figures["contacts"] == 2
    assert figures["least_m"] == pytest.approx(math.hypot(0.1, 0.1))


def test_detection_gaps_count_only_images_in_view() -> None:
    figures = compute_flight_figures(
        build_flight(
            in_view=build_mask((50, 60)), detected=build_mask((10, 12), (48, 66), (190, 200))
        )
    )
    # Gaps: 2 images, then 2 before and 6 after the 10 out of view, then 10 at the end.
    assert figures["silences"] == 4
    assert figures["silence_s"] == pytest.approx(0.5)
    assert figures["longest_silence_s"] == pytest.approx(1.0)
    assert figures["recall"] == pytest.approx(1 - 20 / 190)
    assert figures["find_again_s"] == pytest.approx(0.6)  # in view from 60, detected from 66


def test_false_alarms_have_durations() -> None:
    false = np.zeros(IMAGES)
    false[20:24], false[100:102] = 1, 3
    figures = compute_flight_figures(build_flight(false=false))
    assert figures["false_per_image"] == pytest.approx(10 / IMAGES)
    assert figures["alarm_s"] == pytest.approx(0.3)
    assert figures["longest_alarm_s"] == pytest.approx(0.4)


def test_long_detection_gaps_end_loops() -> None:
    short, long = (
        build_mask(*((k, k + 5) for k in range(0, 150, 15))),
        build_mask((30, 45), (90, 110)),
    )
    times = {
        name: compute_flight_figures(build_flight(found=found))["loop_s"]
        for name, found in (("all", build_mask()), ("short", short), ("long", long))
    }
    assert times == pytest.approx({"all": 40.0, "short": 40.0, "long": 20 / 2.5})
    false = np.zeros(IMAGES)
    false[[3, 4, 90]] = 1
    assert compute_flight_figures(build_flight(false=false))["loop_s"] == pytest.approx(20 / 2.5)


@pytest.mark.parametrize(("images", "loop_s"), [(7, 50.0), (8, 25 / 1.5)])
def test_a_detection_gap_of_a_second_ends_a_loop(images: int, loop_s: float) -> None:
    eighths = build_flight(image_s=0.125 * np.arange(IMAGES), found=build_mask((30, 30 + images)))
    assert compute_flight_figures(eighths)["loop_s"] == pytest.approx(loop_s)


def test_detection_gaps_are_weighted_by_distance_distribution() -> None:
    """Half the images are at 0.8 m, the usual distance of a follower, and half at 2.5 m."""
    distance_m = np.where(np.arange(IMAGES) < 100, 0.8, 2.5)
    near, far = (
        compute_flight_figures(build_flight(distance_m=distance_m, found=build_mask(span)))[
            "loop_s"
        ]
        for span in ((20, 40), (120, 140))
    )
    assert near is not None
    assert far is not None
    assert near < 0.5 * far


def test_bands_hold_the_images_of_their_distance_and_turn_rate() -> None:
    turn = np.where(np.arange(IMAGES) < 50, 1.0, 0.1)
    bands = compute_bands(build_flight(turn_radps=turn, detected=build_mask((0, 25))))
    shown = {(b["by"], b["from"]): (b["in_view"], b["recall"]) for b in bands if b["in_view"]}
    assert shown == {
        ("distance_m", 0.5): (200, 0.875),
        ("turn_radps", 0.0): (150, 1.0),
        ("turn_radps", 0.75): (50, 0.5),
    }


def test_a_flight_without_images_has_no_figures_of_them() -> None:
    none, no = np.zeros(0), np.zeros(0, bool)
    figures = compute_flight_figures(
        PairFlight("a", "b", TRUE_S, build_flight().true_m, none, none, none, no, no, no, none)
    )
    assert figures["held_s"] == pytest.approx(20.0)
    assert figures["recall"] is None
    assert figures["loop_s"] is None
