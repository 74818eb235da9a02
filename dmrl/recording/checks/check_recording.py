"""Check a recording and report findings, errors first.

Errors make a recording unusable. Warnings describe problems to consider before it is used.
`scan` collects all data in one pass over the file; the rules here evaluate them.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from dmrl.errors import RecordingError
from dmrl.geometry.calibration import doubt_focal_length, find_calibration_fault, find_lens_fault
from dmrl.recording.checks.clock_checks import check_clocks
from dmrl.recording.checks.label_checks import check_causes, check_labels
from dmrl.recording.checks.scan import (
    KEPT_TOPICS,
    CheckData,
    Finding,
    ImageSize,
    collect,
    collect_from_index,
    collect_values,
)
from dmrl.recording.checks.unit_checks import check_periods
from dmrl.recording.loaded import LoadedRecording
from dmrl.recording.protobuf.message_types import carries_own_type
from dmrl.terminal.progress import say
from dmrl.topics import CALIBRATION, CAMERA_IMAGE, find_topic, parse_topic

GAP_PERIODS = 10
"""Length of a gap, in median periods of the topic."""
GAP_MIN_S = 0.5
"""Shortest gap that is reported, seconds."""
NUMBER = re.compile(r"\d[\d.e+-]*")
CALIBRATION_FIELDS = ["width", "height", "K", "D", "distortion_model"]
FINDINGS_PRINTED_MAX = 5
"""Findings that a stage prints about its output. ``dmrl check`` prints all."""


def check(path: Path, *, quick: bool = False, values: bool = False) -> list[Finding]:
    """Return the findings about a recording, errors first.

    Parameters
    ----------
    path
        A recording.
    quick
        Check types, times and labels only, without decoding images.
    values
        Check the values of sensors and samples of the images as well, if ``quick``.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    data = collect_from_index(LoadedRecording(path, *KEPT_TOPICS)) if quick else collect(path)
    if quick and values:
        collect_values(data)
    findings = [
        finding
        for rule, of_times_and_labels in RULES.items()
        if of_times_and_labels or not quick or (values and rule in CAMERA_RULES)
        for finding in rule(data)
    ]
    if data.contents.summary.contradiction:
        findings.append(Finding("warning", "", data.contents.summary.contradiction))
    if not data.contents.summary.count:
        findings.append(Finding("error", "", "the recording has no messages"))
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
    found = check_labels(collect_from_index(contents))
    return [f"{finding.topic}: {finding.text}" for finding in found]


def print_findings(path: Path, *, values: bool = False) -> None:
    """Print the first findings about a recording that was just written, on stderr.

    A failed check is printed as a warning: the recording itself is complete.
    """
    try:
        findings = check(path, quick=True, values=values)
    except RecordingError as e:
        say(f"warning: {e}")
        return
    for finding in _sort_by_novelty(findings)[:FINDINGS_PRINTED_MAX]:
        say(finding.to_line())
    if len(findings) > FINDINGS_PRINTED_MAX:
        say(f"{len(findings) - FINDINGS_PRINTED_MAX} more: dmrl check {path}")


def _sort_by_novelty(findings: list[Finding]) -> list[Finding]:
    """Return errors, then warnings, in each one finding of every kind before the second of any."""
    seen: Counter[tuple[str, str]] = Counter()
    turns = []
    for finding in findings:
        kind = finding.level, NUMBER.sub("", finding.text)
        turns.append((finding.level, seen[kind]))
        seen[kind] += 1
    order = sorted(range(len(findings)), key=turns.__getitem__)
    return [findings[k] for k in order]


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
    for topic, times in data.times.items():
        first, last = times.count_steps(-1), times.count_steps(0)
        if first:
            text = f"{first} messages go back in time, by up to {-times.shortest_ns / 1e9:.3f} s"
            yield Finding("warning", topic, text)
        if repeated := last - first:
            yield Finding("warning", topic, f"{repeated} messages repeat the time before them")
        if len(times) - 1 - last < GAP_PERIODS:
            continue
        period_s = times.compute_median_step_ns(last) / 1e9
        limit_ns = int(max(GAP_PERIODS * period_s, GAP_MIN_S) * 1e9)
        gaps = len(times) - 1 - times.count_steps(limit_ns)
        if gaps:
            text = f"{gaps} gaps, the longest {times.longest_ns / 1e9:.3f} s; the usual period"
            yield Finding("warning", topic, f"{text}: {period_s:.3f} s")


def _check_signals(data: CheckData) -> Iterator[Finding]:
    """Report clocks that do not fit, and values that contradict the unit or sign of their topic."""
    for topic, text in (
        *check_clocks(data),
        *data.values.find_not_finite_fields(),
        *data.values.find_implausible_fields(),
        *check_periods(data.times, data.sort_times),
        *data.motion.find_contradictions(),
        *data.images.find_blind_cameras(),
    ):
        yield Finding("warning", topic, text)


def _check_images(data: CheckData) -> Iterator[Finding]:
    """Report images that are unreadable, uncalibrated, or of several sizes."""
    for topic in data.times:
        parts = parse_topic(CAMERA_IMAGE, topic)
        if parts is None:
            continue
        calibration_topic = CALIBRATION(parts["robot"])
        if calibration_topic not in data.times:
            yield Finding("warning", topic, f"no calibration on {calibration_topic}")
        if topic not in data.broken:
            yield from _check_sizes(data, topic, Counter(data.sizes[topic]))


def _check_sizes(data: CheckData, topic: str, sizes: Counter[ImageSize]) -> Iterator[Finding]:
    if unreadable := sizes.pop(None, 0):
        first_ns = ", ".join(f"{ns} ns" for ns in sorted(data.undecodable_ns[topic])[:3])
        text = f"{unreadable} messages contain no readable image: {first_ns}"
        yield Finding("error", topic, text)
    if len(sizes) > 1:
        text = f"images of {len(sizes)} sizes: {_list_sizes(sizes)}"
        yield Finding("warning", topic, text)


def _list_sizes(sizes: Iterable[ImageSize]) -> str:
    return ", ".join(f"{w}x{h}" for w, h in sorted(filter(None, sizes)))


def _check_calibrated_sizes(data: CheckData) -> Iterator[Finding]:
    """Report images that are not of the calibrated size."""
    for topic, counts in data.sizes.items():
        parts, sizes = parse_topic(CAMERA_IMAGE, topic), {*counts} - {None}
        calibration_topic = CALIBRATION(parts["robot"]) if parts else ""
        known = calibration_topic in data.times and not {topic, calibration_topic} & {*data.broken}
        if not known or not sizes:
            continue
        table = data.contents.get_table(calibration_topic, ["width", "height"])
        calibrated = set(zip(table["width"].to_pylist(), table["height"].to_pylist(), strict=True))
        if calibrated and not calibrated & sizes:
            width, height = min(calibrated)
            text = f"images of {_list_sizes(sizes)}, but the calibration is for {width}x{height}"
            yield Finding("error", topic, text)


def _check_grids(data: CheckData) -> Iterator[Finding]:
    """Report grid maps whose data are not of the size that they state."""
    for topic, wrong in data.misfit_grids.items():
        if wrong:
            text = f"{wrong} maps do not have 4 bytes for each cell of each channel"
            yield Finding("error", topic, text)


def _check_calibrations(data: CheckData) -> Iterator[Finding]:
    """Report calibrations that no camera can have, and uncalibrated cameras."""
    for topic, info in data.contents.topics.items():
        mine = parse_topic(CALIBRATION, topic) is not None and carries_own_type(topic, info.schema)
        if not mine or topic in data.broken:
            continue
        table = data.contents.get_table(topic, CALIBRATION_FIELDS)
        columns = [table[name].to_pylist() for name in CALIBRATION_FIELDS]
        for width_px, height_px, k, d, model in zip(*columns, strict=True):
            if why := find_calibration_fault(width_px, height_px, k, d):
                yield Finding("error" if any(k) else "warning", topic, why)
                break
            if why := find_lens_fault(model, d) or doubt_focal_length(width_px, k[0]):
                yield Finding("warning", topic, why)
                break


RULES: dict[Callable[[CheckData], Iterator[Finding]], bool] = {
    _check_types: True,
    _check_times: True,
    _check_signals: True,
    _check_images: False,
    _check_calibrated_sizes: False,
    _check_grids: False,
    _check_calibrations: False,
    check_labels: True,
    check_causes: False,
}
"""Rules, in the order of their findings, and whether each belongs to a quick check."""
CAMERA_RULES = (_check_calibrated_sizes, _check_calibrations)
"""Rules that belong to a quick check of values, too."""
