"""Inconsistent files with correct checksums lose no message without an error.

The oracle is `walk`, an independent parser. Outputs are read by it and by mcap's own readers,
with and without their indexes.
"""

import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from dmrl import open as open_recording
from dmrl import writer
from dmrl.errors import DmrlError
from dmrl.recording import read_raw, recover
from dmrl.recording import trim as trim_range
from dmrl.stages import check, info, merge, trim
from dmrl.stages.recover import describe_losses

from .test_conformance import read_by_mcap
from .walk import Content, walk
from .wrong_meaning import FAULTS, draw_file

MAX_NS = 2**63 - 1
SAMPLE, MANY = 100, 10_000


def read_readable_content(path: Path) -> Content:
    """Return the content of a file, without messages that lack a channel definition."""
    found = walk(path)
    found.set_aside_nameless()
    return found


def assert_same_for_every_reader(out: Path, want: dict[str, list]) -> None:
    """Assert that a copy has the wanted content for three independent readers."""
    assert walk(out).comparable() == read_by_mcap(out).comparable() == want
    with out.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        got = [(c.topic, m.log_time, m.sequence, m.data) for _, c, m in reader.iter_messages()]
    assert sorted(got) == sorted((m[0][0], m[1], m[3], m[4]) for m in want["messages"])


def result_or_none(read: Callable[[], Any]) -> Any:
    """Return the result of a command, or None if it raises a DmrlError of one line."""
    try:
        return read()
    except DmrlError as e:
        assert "\n" not in str(e)
        return None


def select_time_range(content: Content, low: int, high: int) -> dict[str, list]:
    """Return the content with only the messages from ``low`` to before ``high``, ns."""
    want = content.comparable()
    return want | {"messages": [m for m in want["messages"] if low <= m[1] < high]}


def check_copies(path: Path, empty: Path, out: Path, content: Content) -> None:
    """Assert that trim and merge write complete copies or raise an error."""
    want = content.comparable()
    times = sorted({m[1] for m in want["messages"] if m[1] < MAX_NS})
    ranges = [(times[len(times) // 3], times[-1] + 1), (times[0], times[-1])] if times else []
    tried: list[tuple[Callable[[], Any], dict[str, list]]] = [
        (lambda: trim.run(path, out, trim.Settings()), want),
        (lambda: merge.run([path, empty], out), want),
    ]
    for low, high in ranges:
        tried.append(
            (
                lambda low=low, high=high: trim_range(path, out, start_ns=low, end_ns=high),
                select_time_range(content, low, high),
            )
        )
    for copy, expected in tried:
        if result_or_none(copy) is None:
            assert not out.exists()
            continue
        assert not content.unreadable
        found = walk(out).comparable()
        if expected is not want:  # channels without messages in the range are left out
            expected = expected | {k: found[k] for k in ("channels", "schemas")}
        assert_same_for_every_reader(out, expected)
        out.unlink()


def check_reads(path: Path, content: Content) -> None:
    """Assert that info, check and the readers count and read every message, or raise an error."""
    want = content.comparable()["messages"]
    counts = Counter(channel[0] for channel, *_ in want)
    if (overview := result_or_none(lambda: info.run(path).to_document())) is not None:
        topics = {topic: one["count"] for topic, one in overview["topics"].items()}
        assert topics == {c[0]: counts[c[0]] for c in content.comparable()["channels"]}
        assert overview["start_ns"] == min((m[1] for m in want), default=0)
        assert not content.unreadable
    if (checked := result_or_none(lambda: check.run(path))) is not None and not any(
        finding.level == "error" for finding in checked.findings
    ):
        assert checked.messages == len(want)
        assert not content.unreadable
    held = result_or_none(lambda: open_recording(path))
    assert held is None or held._summary.count == len(want)
    for topic in counts:
        rows = sorted((m[1], m[2], m[4]) for m in want if m[0][0] == topic)
        for low, high in ((None, None), (rows[0][0], rows[-1][0])):
            found = result_or_none(
                lambda topic=topic, low=low, high=high: [
                    (raw.time_ns, raw.publish_ns, raw.data)
                    for raw in read_raw(path, topic, start_ns=low, end_ns=high)
                ]
            )
            if found is not None:
                inside = [r for r in rows if low is None or low <= r[0] < high]
                assert sorted(found) == inside


def check_recovery(path: Path, out: Path, content: Content) -> None:
    """Assert that recover restores every readable message and reports the losses."""
    want = content.comparable()
    report = result_or_none(lambda: recover(path, out))
    if report is None:
        assert not want["messages"]
        return
    timed = [m for m in want["messages"] if m[1] < MAX_NS and m[2] <= MAX_NS]
    found = walk(out).comparable()
    if "a channel is defined otherwise" not in content.unreadable:
        lost = Counter(map(repr, timed)) - Counter(map(repr, found["messages"]))
        # Messages whose channel is defined only in the summary are counted as nameless.
        assert lost.total() <= report.nameless
        assert len(found["messages"]) == len(timed) - lost.total()
    assert len(found["messages"]) == report.messages
    if report.whole:
        assert not content.unreadable and len(timed) == len(want["messages"])
        assert_same_for_every_reader(out, want)
    else:
        assert describe_losses(report)
    out.unlink()


def check_commands(seed: int, path: Path, out: Path, empty: Path) -> tuple[str, ...]:
    """Draw a file from a seed and check every command on it; return its faults."""
    data, faults = draw_file(Random(seed))
    path.unlink(missing_ok=True)
    out.unlink(missing_ok=True)
    path.write_bytes(data)
    os.utime(path, (10**9 + seed, 10**9 + seed))  # only summaries of older files are cached
    content = read_readable_content(path)
    if not faults:
        assert read_by_mcap(path).comparable() == content.comparable()
    check_reads(path, content)
    check_copies(path, empty, out, content)
    check_recovery(path, out, content)
    return faults


@pytest.fixture
def places(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Return the paths of an input, an output, and an empty recording to merge with."""
    empty = tmp_path / "empty.mcap"
    with writer(empty):
        pass
    return tmp_path / "in.mcap", tmp_path / "out.mcap", empty


@pytest.mark.parametrize(
    "part", [0, *(pytest.param(part, marks=pytest.mark.heavy) for part in range(1, 5))]
)
@pytest.mark.heavy
def test_hundred_inconsistent_files_lose_no_message_silently(
    places: tuple[Path, Path, Path], part: int
) -> None:
    for seed in range(part, SAMPLE, 5):
        check_commands(seed, *places)


@pytest.mark.slow
def test_ten_thousand_inconsistent_files_lose_no_message_silently(
    places: tuple[Path, Path, Path], record_property: Callable[[str, object], None]
) -> None:
    """``--junitxml FILE -o junit_family=xunit1`` records the number of files by fault."""
    seen: Counter[str] = Counter()

    @settings(max_examples=MANY, derandomize=True, database=None)
    @given(st.integers(SAMPLE, 2**31))
    def judge_seed(seed: int) -> None:
        seen.update(check_commands(seed, *places) or ("none",))

    judge_seed()
    record_property("files by fault", dict(sorted(seen.items())))
    assert seen.keys() == {*FAULTS, "padded", "none"}
