"""Check a recording and report findings, errors first.

Errors make a recording unusable. Warnings describe problems to consider before it is used.
`scan` collects all data in one pass over the file; the rules here evaluate them.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from dmrl.errors import RecordingError
from dmrl.geometry.calibration import find_calibration_fault
from dmrl.recording.checks.clock_checks import check_clocks
from dmrl.recording.checks.finding import Finding
from dmrl.recording.checks.label_checks import check_causes, check_labels
from dmrl.recording.checks.scan import (
    KEPT_TOPICS,
    CheckData,
    ImageSize,
    carries_own_type,
    collect,
    collect_from_index,
    collect_values,
)
from dmrl.recording.checks.unit_checks import check_periods
from dmrl.recording.loaded import LoadedRecording
from dmrl.recording.mcap.message_batch import Ints
from dmrl.terminal.progress import say
from dmrl.topics import CALIBRATION, CAMERA_IMAGE, find_topic, parse_topic

GAP_PERIODS = 10
"""Length of a gap, in median periods of the topic."""
GAP_MIN_S = 0.5
"""Shortest gap that is reported, seconds."""
FINDINGS_PRINTED_MAX = 5
"""Findings that a stage prints about its output. ``dmrl check`` prints all."""


def check(path: Path, *, quick: bool = False, values: bool = False) -> list[Finding]:
    """Return the findings about a recording, errors first.

    Parameters
    ----------
    path
        A recording.
    quick
        Check times and labels only, without decoding images.
    values
        Check the values of sensors and samples of the images as well, if ``quick``.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    rules: tuple[Callable[[CheckData], Iterator[Finding]], ...] = (
        _check_times,
        _check_clocks,
        _check_units,
        check_labels,
    )
    data = collect_from_index(LoadedRecording(path, *KEPT_TOPICS)) if quick else collect(path)
    if quick and values:
        collect_values(data)
    if not quick:
        rules = (
            _check_types,
            _check_times,
            _check_clocks,
            _check_units,
            _check_images,
            _check_calibrations,
            check_labels,
            check_causes,
        )
    findings = [finding for rule in rules for finding in rule(data)]
    if data.contents.summary.contradiction:
        findings.append(Finding("warning", "", data.contents.summary.contradiction))
    if not data.contents.summary.count:
        findings.append(Finding("error", "", "has no messages"))
    return sorted(findings, key=lambda f: f.level)


def list_label_findings(contents: LoadedRecording) -> list[str]:
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
    return [
        f"{finding.topic}: {finding.text}" for finding in check_labels(collect_from_index(contents))
    ]


def print_findings(path: Path, *, values: bool = False) -> None:
    """Print the first findings about a recording that was just written, on stderr.

    A failed check is printed as a warning: the recording itself is complete.
    """
    try:
        findings = check(path, quick=True, values=values)
    except RecordingError as e:
        say(f"warning: {e}")
        return
    for finding in findings[:FINDINGS_PRINTED_MAX]:
        say(f"{finding.level}: {finding.topic}: {finding.text}")
    if len(findings) > FINDINGS_PRINTED_MAX:
        say(f"{len(findings) - FINDINGS_PRINTED_MAX} more: dmrl check {path}")


def _check_types(data: CheckData) -> Iterator[Finding]:
    """Report topics of a wrong message type, and messages that are not of their type."""
    for topic, info in data.contents.topics.items():
        row = find_topic(topic)
        if row is not None and not carries_own_type(topic, info.schema):
            yield Finding(
                "error", topic, f"carries {info.schema or 'no schema'}, not {row.message}"
            )
    for topic, why in data.broken.items():
        yield Finding("error", topic, why)


def _check_times(data: CheckData) -> Iterator[Finding]:
    """Report times that go back or repeat in the file, and gaps in periodic topics."""
    for topic, time_ns in data.times.items():
        step_ns = np.diff(time_ns)
        if (back := step_ns[step_ns < 0]).size:
            yield Finding(
                "warning",
                topic,
                f"{back.size} messages go back in time, by up to {-back.min() / 1e9:.3f} s",
            )
        if repeated := int((step_ns == 0).sum()):
            yield Finding("warning", topic, f"{repeated} messages repeat the time before them")
        yield from _check_gaps(topic, step_ns[step_ns > 0])


def _check_clocks(data: CheckData) -> Iterator[Finding]:
    """Report clocks that do not fit together."""
    return (Finding("warning", topic, text) for topic, text in check_clocks(data))


def _check_units(data: CheckData) -> Iterator[Finding]:
    """Report values and times that contradict the unit, frame or sign of their topic."""
    for topic, text in (
        *data.magnitudes.find_not_finite_fields(),
        *data.magnitudes.find_implausible_fields(),
        *check_periods(data.times),
        *data.motion.find_contradictions(),
        *data.images.find_blind_cameras(),
    ):
        yield Finding("warning", topic, text)


def _check_gaps(topic: str, step_ns: Ints) -> Iterator[Finding]:
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


def _check_images(data: CheckData) -> Iterator[Finding]:
    """Report images that are unreadable, uncalibrated, or not of the calibrated size."""
    for topic in data.times:
        parts = parse_topic(CAMERA_IMAGE, topic)
        if parts is None:
            continue
        calibration_topic = CALIBRATION(parts["robot"])
        if calibration_topic not in data.times:
            yield Finding("warning", topic, f"no calibration on {calibration_topic}")
        if topic not in data.broken:
            yield from _check_sizes(data, topic, calibration_topic, Counter(data.sizes[topic]))


def _check_sizes(
    data: CheckData, topic: str, calibration_topic: str, sizes: Counter[ImageSize]
) -> Iterator[Finding]:
    if unreadable := sizes.pop(None, 0):
        first_ns = ", ".join(f"{ns} ns" for ns in sorted(data.undecodable_ns[topic])[:3])
        yield Finding(
            "error", topic, f"{unreadable} messages contain no readable image: {first_ns}"
        )
    listed = ", ".join(f"{w}x{h}" for w, h in sorted(k for k in sizes if k))
    if len(sizes) > 1:
        yield Finding("warning", topic, f"images of {len(sizes)} sizes: {listed}")
    if calibration_topic not in data.times or calibration_topic in data.broken or not sizes:
        return
    table = data.contents.get_table(calibration_topic, ["width", "height"])
    calibrated_sizes = set(
        zip(table["width"].to_pylist(), table["height"].to_pylist(), strict=True)
    )
    if calibrated_sizes and not calibrated_sizes & sizes.keys():
        width, height = sorted(calibrated_sizes)[0]
        yield Finding(
            "error", topic, f"images of {listed}, but the calibration is for {width}x{height}"
        )


def _check_calibrations(data: CheckData) -> Iterator[Finding]:
    """Report calibrations that no camera can have, and uncalibrated cameras."""
    for topic, info in data.contents.topics.items():
        mine = parse_topic(CALIBRATION, topic) is not None and carries_own_type(topic, info.schema)
        if not mine or topic in data.broken:
            continue
        table = data.contents.get_table(topic, ["width", "height", "K", "D"])
        columns = [table[name].to_pylist() for name in ("width", "height", "K", "D")]
        for width_px, height_px, k, d in zip(*columns, strict=True):
            if why := find_calibration_fault(width_px, height_px, k, d):
                yield Finding("error" if any(k) else "warning", topic, why)
                break
