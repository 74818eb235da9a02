"""Check a recording and report findings, errors first.

Errors make a recording unusable. Warnings describe problems to consider before it is used.
`scan` collects all data in one pass over the file; the rules here evaluate them.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from dmrl.errors import RecordingError
from dmrl.geometry.calibration import no_camera
from dmrl.recording.checks.clock_checks import clocks
from dmrl.recording.checks.finding import Finding
from dmrl.recording.checks.label_checks import labels
from dmrl.recording.checks.scan import HELD, Seen, Size, carries, glimpse, look
from dmrl.recording.checks.unit_checks import periods
from dmrl.recording.loaded import Contents
from dmrl.recording.mcap.message_batch import Ints
from dmrl.terminal.progress import say
from dmrl.topics import CALIBRATION, CAMERA_IMAGE, calibration, names, row_of

GAP_PERIODS = 10
"""Length of a gap, in median periods of the topic."""
GAP_MIN_S = 0.5
"""Shortest gap that is reported, seconds."""
SAID = 2
"""Findings that a stage prints about its output. ``dmrl check`` prints all."""


def check(path: Path, *, quick: bool = False) -> list[Finding]:
    """Return the findings about a recording, errors first.

    Parameters
    ----------
    path
        A recording.
    quick
        Check times and labels only, without decoding images.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    rules: tuple[Callable[[Seen], Iterator[Finding]], ...] = (_times, _clocks, _units, labels)
    seen = glimpse(Contents(path, *HELD)) if quick else look(path)
    if not quick:
        rules = _types, _times, _clocks, _units, _images, _calibrations, labels
    findings = [finding for rule in rules for finding in rule(seen)]
    if not seen.contents.summary.count:
        findings.append(Finding("error", "", "has no messages"))
    return sorted(findings, key=lambda f: f.level)


def label_findings(contents: Contents) -> list[str]:
    """Return the findings about the labels of a recording, such as a bias, one line each.

    Parameters
    ----------
    contents
        A recording with its labels and calibrations in memory.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    return [f"{finding.topic}: {finding.text}" for finding in labels(glimpse(contents))]


def say_findings(path: Path) -> None:
    """Print the first findings about a recording that was just written, on stderr.

    A failed check is printed as a warning: the recording itself is complete.
    """
    try:
        findings = check(path, quick=True)
    except RecordingError as e:
        say(f"warning: {e}")
        return
    for finding in findings[:SAID]:
        say(f"{finding.level}: {finding.topic}: {finding.text}")
    if len(findings) > SAID:
        say(f"{len(findings) - SAID} more: dmrl check {path}")


def _types(seen: Seen) -> Iterator[Finding]:
    """Report topics of a wrong message type, and messages that are not of their type."""
    for topic, info in seen.contents.topics.items():
        row = row_of(topic)
        if row is not None and not carries(topic, info.schema):
            yield Finding(
                "error", topic, f"carries {info.schema or 'no schema'}, not {row.message}"
            )
    for topic, why in seen.broken.items():
        yield Finding("error", topic, why)


def _times(seen: Seen) -> Iterator[Finding]:
    """Report times that go back or repeat in the file, and gaps in periodic topics."""
    for topic, time_ns in seen.times.items():
        step_ns = np.diff(time_ns)
        if (back := step_ns[step_ns < 0]).size:
            yield Finding(
                "warning",
                topic,
                f"{back.size} messages go back in time, by up to {-back.min() / 1e9:.3f} s",
            )
        if repeated := int((step_ns == 0).sum()):
            yield Finding("warning", topic, f"{repeated} messages repeat the time before them")
        yield from _gaps(topic, step_ns[step_ns > 0])


def _clocks(seen: Seen) -> Iterator[Finding]:
    """Report clocks that do not fit together."""
    return (Finding("warning", topic, text) for topic, text in clocks(seen))


def _units(seen: Seen) -> Iterator[Finding]:
    """Report values and times that contradict the unit, frame or sign of their topic."""
    for topic, text in (*seen.values.doubted(), *periods(seen.times), *seen.moved.doubted()):
        yield Finding("warning", topic, text)


def _gaps(topic: str, step_ns: Ints) -> Iterator[Finding]:
    if step_ns.size < GAP_PERIODS:
        return
    period_s = float(np.median(step_ns)) / 1e9
    gaps = step_ns[step_ns > max(GAP_PERIODS * period_s, GAP_MIN_S) * 1e9] / 1e9
    if gaps.size:
        yield Finding(
            "warning",
            topic,
            f"{gaps.size} gaps, the longest {gaps.max():.3f} s; the usual period: {period_s:.3f} s",
        )


def _images(seen: Seen) -> Iterator[Finding]:
    """Report images that are unreadable, uncalibrated, or not of the calibrated size."""
    for topic in seen.times:
        parts = names(CAMERA_IMAGE, topic)
        if parts is None:
            continue
        calibrated = calibration(parts["robot"])
        if calibrated not in seen.times:
            yield Finding("warning", topic, f"no calibration on {calibrated}")
        if topic not in seen.broken:
            yield from _sizes(seen, topic, calibrated, Counter(seen.sizes[topic]))


def _sizes(seen: Seen, topic: str, calibrated: str, sizes: Counter[Size]) -> Iterator[Finding]:
    if unreadable := sizes.pop(None, 0):
        yield Finding("error", topic, f"{unreadable} messages contain no readable image")
    listed = ", ".join(f"{w}x{h}" for w, h in sorted(k for k in sizes if k))
    if len(sizes) > 1:
        yield Finding("warning", topic, f"images of {len(sizes)} sizes: {listed}")
    if calibrated not in seen.times or calibrated in seen.broken or not sizes:
        return
    table = seen.contents.table(calibrated, ["width", "height"])
    known = set(zip(table["width"].to_pylist(), table["height"].to_pylist(), strict=True))
    if known and not known & sizes.keys():
        width, height = sorted(known)[0]
        yield Finding(
            "error", topic, f"images of {listed}, but the calibration is for {width}x{height}"
        )


def _calibrations(seen: Seen) -> Iterator[Finding]:
    """Report calibrations that no camera can have, and uncalibrated cameras."""
    for topic, info in seen.contents.topics.items():
        mine = names(CALIBRATION, topic) is not None and carries(topic, info.schema)
        if not mine or topic in seen.broken:
            continue
        table = seen.contents.table(topic, ["width", "height", "K", "D"])
        columns = [table[name].to_pylist() for name in ("width", "height", "K", "D")]
        for width_px, height_px, k, d in zip(*columns, strict=True):
            if why := no_camera(width_px, height_px, k, d):
                yield Finding("error" if any(k) else "warning", topic, why)
                break
