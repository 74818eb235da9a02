"""Is a recording what it should be? Findings in words, worst first.

Errors make a recording wrong to use; warnings are what a person should know before using it.
All that is needed is gathered in one pass (`check_seen`), then judged.
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

GAP_PERIODS = 10  # a hole this many times the usual period is a gap
GAP_MIN_S = 0.5
SAID = 2
"""Findings that a stage says of what it wrote; dmrl check says them all."""


def check(path: Path, *, quick: bool = False) -> list[Finding]:
    """Everything wrong with a recording, errors first; empty if nothing is.

    Parameters
    ----------
    path
        A recording.
    quick
        Its times and labels only, for which images need not be looked at.

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
    """What is wrong with the labels of a recording, a line each, such as a bias.

    Parameters
    ----------
    contents
        Holds labels and calibrations.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    return [f"{finding.topic}: {finding.text}" for finding in labels(glimpse(contents))]


def say_findings(path: Path) -> None:
    """Say on stderr, in a line or two, what is odd in a recording that was just written.

    It stands, and is whole: what cannot be judged in it is no error of the work.
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
    """Topics with another type than theirs, or messages that are not of it."""
    for topic, info in seen.contents.topics.items():
        row = row_of(topic)
        if row is not None and not carries(topic, info.schema):
            yield Finding(
                "error", topic, f"carries {info.schema or 'no schema'}, not {row.message}"
            )
    for topic, why in seen.broken.items():
        yield Finding("error", topic, why)


def _times(seen: Seen) -> Iterator[Finding]:
    """Times that go back or repeat in the file, and gaps in topics that have a rhythm."""
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
    """Times that do not belong together."""
    return (Finding("warning", topic, text) for topic, text in clocks(seen))


def _units(seen: Seen) -> Iterator[Finding]:
    """Values and times that cannot be in the units, frames and signs of their topics."""
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
    """Images without calibration, of another size than calibrated, or that are no images."""
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
        yield Finding("error", topic, f"{unreadable} messages hold no image that can be read")
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
    """Calibrations that no camera can have, and cameras that are not calibrated."""
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
