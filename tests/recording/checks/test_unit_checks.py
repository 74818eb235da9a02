"""Checks of units of values and periods, in constant memory."""

import numpy as np
import pyarrow as pa
import pytest

from dmrl.recording.checks.topic_times import TopicTimes
from dmrl.recording.checks.unit_checks import ValueCounts, check_periods, check_units


def find_doubts(topic: str, name: str, values: np.ndarray) -> list[tuple[str, str]]:
    """Return topic and text of every doubt about a field with these values."""
    sizes = ValueCounts()
    for part in np.array_split(values, 3):
        sizes.add_batch(topic, pa.RecordBatch.from_pydict({name: pa.array(part)}))
    return [*sizes.find_not_finite_fields(), *sizes.find_implausible_fields()]


@pytest.mark.parametrize(
    ("topic", "name", "usual"),
    [
        ("/cf1/height", "height_m", 0.8),
        ("/cf1/velocity", "vx_mps", 0.5),
        ("/cf1/range/cf2", "range_m", 3.0),
        ("/cf1/attitude", "roll_rad", 0.05),
    ],
)
def test_values_a_thousand_times_too_large_are_doubted(topic: str, name: str, usual: float) -> None:
    values = usual * np.random.default_rng(1).uniform(-1, 1, 200)
    assert find_doubts(topic, name, values) == []
    ((where, text),) = find_doubts(topic, name, 1000 * values)
    assert where == topic and text.startswith(f"{name}: ")


def test_unit_finding_needs_more_than_a_tenth_of_the_values() -> None:
    values = np.full(100, 0.5)
    values[:10] = 500.0
    assert find_doubts("/cf1/height", "height_m", values) == []
    values[10] = -500.0
    ((_, text),) = find_doubts("/cf1/height", "height_m", values)
    assert text == "height_m: 11% of the values are over 30 m. Are they mm or cm?"


def test_implausible_single_values_are_found() -> None:
    values = np.full(100, 0.5)
    values[3] = -1e30
    ((_, text),) = find_doubts("/cf1/velocity", "vx_mps", values)
    assert text == "vx_mps: 1 of 100 values are over 20000 m/s, which no flight gives"


def test_heights_that_count_downwards_are_found() -> None:
    ((_, text),) = find_doubts("/cf1/height", "height_m", np.full(100, -1.2))
    assert text == "height_m: 100% of the values are below the floor. Is z down?"
    assert find_doubts("/cf1/height", "height_m", np.full(100, -0.1)) == []
    assert find_doubts("/cf1/height", "height_m", np.r_[np.full(50, -1.0), np.full(50, 1.0)]) == []


def test_unit_check_ignores_zeros_non_finite_values_and_short_series() -> None:
    odd = np.array([np.nan, np.inf, -np.inf, 0.0] * 30)
    ((_, text),) = find_doubts("/cf1/height", "height_m", odd)
    assert text == "height_m: 90 values are not finite"
    assert find_doubts("/cf1/height", "height_m", np.full(19, 500.0)) == []
    assert find_doubts("/own/topic", "height_m", np.full(99, 500.0)) == []


def find_period(times: np.ndarray, topic: str = "/cf1/height") -> list[str]:
    """Return the findings about the period of a topic with messages at these times, ns."""
    held = {topic: TopicTimes.of(times)}
    return [text for _, text in check_periods(held, lambda _: TopicTimes.of(np.sort(times)))]


def test_sensor_periods_out_of_range_are_found() -> None:
    times = np.arange(100) * 10_000_000
    assert find_period(times) == []
    assert find_period(times * 1000) == ["one message in 10 s. Were its times in ms, us or ns?"]
    assert "in s, ms or us" in find_period(times // 1_000_000)[0]
    assert find_period(times * 1000, "/cf1/labels") == []
    assert find_period(times[:19] * 1000) == []


def test_period_of_unsorted_times_is_that_of_the_sorted_times() -> None:
    times = np.arange(100) * 10_000_000
    assert find_period(np.random.default_rng(0).permutation(times)) == []
    assert find_period(times[::-1] * 1000) == find_period(times * 1000) != []


@pytest.mark.parametrize(
    ("period_ns", "said"),
    [(4_900_000_000, 0), (5_100_000_000, 1), (190_000, 1), (210_000, 0), (0, 0)],
)
def test_sensor_period_limits_are_exact(period_ns: int, said: int) -> None:
    times = np.arange(20) * period_ns
    assert len(find_period(times)) == said
    assert find_period(times[:19]) == []


def test_magnitudes_are_binned_to_a_fifth_of_the_limit() -> None:
    assert find_doubts("/cf1/height", "height_m", np.full(20, 30.0)) == []
    assert len(find_doubts("/cf1/height", "height_m", np.full(20, 36.0))) == 1
    for tiny, huge in ((1e-80, 1e80), (-1e-300, -1e300)):
        ((_, text),) = find_doubts("/cf1/height", "height_m", np.full(20, tiny))
        assert "are under 0.005 m" in text
        assert len(find_doubts("/cf1/height", "height_m", np.full(20, huge))) == 1


def test_positions_in_millimetres_are_doubted() -> None:
    place = {"pose": {"position": {"x": 1200.0, "y": 2.0, "z": 3.0}}}
    for topic in ("/cf1/pose", "/cf1/pose/truth"):
        found = check_units(topic, pa.Table.from_pylist([place] * 30))
        share = "pose.position.x: 100% of the values are over 300 m"
        assert found == [f"{share}. Are they mm or cm?"]
