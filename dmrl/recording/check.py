"""Is a recording what it should be? Findings in words, worst first.

Errors make a recording wrong to use; warnings are what a person should know before using it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl.errors import DmrlError, RecordingError
from dmrl.geometry.frames import inside
from dmrl.images.codec import size
from dmrl.recording.blocks import in_file_order
from dmrl.recording.check_clocks import clocks
from dmrl.recording.index import Summary, summary
from dmrl.recording.reader import by_topic, columns, log_times, read_table
from dmrl.terminal.progress import say
from dmrl.topics import (
    CAMERA_IMAGE,
    LABELS,
    calibration,
    camera_image,
    names,
    row_of,
)

GAP_PERIODS = 10  # a hole this many times the usual period is a gap
GAP_MIN_S = 0.5
BIAS_MIN_LABELS = 20
# A true centre is not exactly the middle of its box: the published renders, labelled with
# their true projection, sit 0.6 px beside it. 1.5 px is twice that and more.
BIAS_MIN_PX = 1.5
BIAS_MIN_SIGMAS = 5.0
SAID = 2
"""Findings that a stage says of what it wrote; dmrl check says them all."""
BORDER_PX = 1.0  # a box this near the border is cut by it, so its middle says nothing


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing wrong with a recording.

    Parameters
    ----------
    level
        "error" or "warning".
    topic
        Where; empty for the recording as a whole.
    text
        What, in one line.
    """

    level: Literal["error", "warning"]
    topic: str
    text: str


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
    found = summary(path)
    rules: tuple[Callable[[Path, Summary], Iterator[Finding]], ...] = (
        _messages,
        _clocks,
        _images,
        _labels,
    )
    if quick:
        rules = _indexed, _clocks, _labels
    findings = [finding for rule in rules for finding in rule(path, found)]
    if not found.count:
        findings.append(Finding("error", "", "has no messages"))
    return sorted(findings, key=lambda f: f.level)


def label_findings(path: Path) -> list[str]:
    """What is wrong with the labels of a recording, a line each, such as a bias.

    Raises
    ------
    RecordingError
        If the file is not a complete recording.
    """
    return [f"{finding.topic}: {finding.text}" for finding in _labels(path, summary(path))]


def say_findings(path: Path) -> None:
    """Say on stderr, in a line or two, what is odd in a recording that was just written."""
    findings = check(path, quick=True)
    for finding in findings[:SAID]:
        say(f"{finding.level}: {finding.topic}: {finding.text}")
    if len(findings) > SAID:
        say(f"{len(findings) - SAID} more: dmrl check {path}")


def _indexed(path: Path, found: Summary) -> Iterator[Finding]:
    """Times as the index has them: no message is read."""
    for topic, time_ns in log_times(path, found.topics).items():
        yield from _times(topic, time_ns)


def _messages(path: Path, found: Summary) -> Iterator[Finding]:
    """Every message against its type and its time, in one pass over the file."""
    known = {topic for topic, info in found.topics.items() if _carries(topic, info.schema)}
    for topic, info in found.topics.items():
        row = row_of(topic)
        if row is not None and topic not in known:
            yield Finding(
                "error", topic, f"carries {info.schema or 'no schema'}, not {row.message}"
            )
    times: dict[str, list[NDArray[np.int64]]] = {topic: [] for topic in found.topics}
    broken: dict[str, str] = {}
    for block, channels in in_file_order(path):
        for number in np.unique(block.channel).tolist():
            topic = channels[number].topic
            mine = block.take(block.channel == number)
            times[topic].append(mine.time_ns)
            if topic in known and topic not in broken:
                try:
                    by_topic(path, mine, channels, {topic: None})
                except RecordingError as e:
                    broken[topic] = str(e)
    for topic, why in broken.items():
        yield Finding("error", topic, why)
    for topic, parts in times.items():
        yield from _times(topic, np.concatenate([np.empty(0, np.int64), *parts]))


def _carries(topic: str, schema: str) -> bool:
    """Whether a topic is dmrl's, and carries what it should."""
    row = row_of(topic)
    return row is not None and row.carries(schema)


def _times(topic: str, time_ns: NDArray[np.int64]) -> Iterator[Finding]:
    """Times that go back or repeat in the file, and gaps in topics that have a rhythm."""
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


def _clocks(path: Path, found: Summary) -> Iterator[Finding]:
    """Times that do not belong together."""
    return (Finding("warning", topic, text) for topic, text in clocks(path, found))


def _gaps(topic: str, step_ns: NDArray[np.int64]) -> Iterator[Finding]:
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


def _images(path: Path, found: Summary) -> Iterator[Finding]:
    """Images without calibration, of another size than calibrated, or that are no images."""
    for topic in found.topics:
        parts = names(CAMERA_IMAGE, topic)
        if parts is None:
            continue
        calibrated = calibration(parts["robot"])
        if calibrated not in found.topics:
            yield Finding("warning", topic, f"no calibration on {calibrated}")
        try:
            sizes = _image_sizes(path, topic)
        except RecordingError:
            continue  # said already
        yield from _size_findings(
            path, topic, calibrated if calibrated in found.topics else None, sizes
        )


def _image_sizes(path: Path, topic: str) -> dict[tuple[int, int] | None, int]:
    """Number of images by (width, height); None for data that is no image."""
    counts: dict[tuple[int, int] | None, int] = {}
    for batch in columns(path, topic, fields=["data"]):
        for data in batch["data"]:
            try:
                width, height, _ = size(data.as_py())
                key: tuple[int, int] | None = (width, height)
            except (DmrlError, ValueError):
                key = None
            counts[key] = counts.get(key, 0) + 1
    return counts


def _size_findings(
    path: Path, topic: str, calibrated: str | None, sizes: dict[tuple[int, int] | None, int]
) -> Iterator[Finding]:
    if unreadable := sizes.pop(None, 0):
        yield Finding("error", topic, f"{unreadable} messages hold no image that can be read")
    listed = ", ".join(f"{w}x{h}" for w, h in sorted(k for k in sizes if k))
    if len(sizes) > 1:
        yield Finding("warning", topic, f"images of {len(sizes)} sizes: {listed}")
    if calibrated is None or not sizes:
        return
    table = read_table(path, calibrated, fields=["width", "height"])
    known = set(zip(table["width"].to_pylist(), table["height"].to_pylist(), strict=True))
    if known and not known & sizes.keys():
        width, height = sorted(known)[0]
        yield Finding(
            "error", topic, f"images of {listed}, but the calibration is for {width}x{height}"
        )


def _labels(path: Path, found: Summary) -> Iterator[Finding]:
    """Labels without image, outside the image, with impossible values, or biased."""
    for topic in found.topics:
        parts = names(LABELS, topic)
        if parts is None or found.topics[topic].schema != "dmrl.v1.PeerLabels":
            continue
        try:
            table = read_table(path, topic)
        except RecordingError:
            continue  # said already
        image = camera_image(parts["robot"])
        yield from _without_image(path, found, topic, image, table)
        peers = _flat(table["peers"])
        bounds = _bounds(path, found, parts["robot"])
        for source in sorted(set(peers["source"].to_pylist())):
            of_source = peers.filter(pc.equal(peers["source"], source))
            yield from _values(topic, source, of_source, bounds)
            yield from _bias(topic, source, of_source, bounds)


def _flat(peers: pa.ChunkedArray) -> pa.Table:
    """One row per peer and source."""
    flat = pc.list_flatten(peers)
    return pa.table({f.name: pc.struct_field(flat, f.name) for f in flat.type})


def _without_image(
    path: Path, found: Summary, topic: str, image: str, table: pa.Table
) -> Iterator[Finding]:
    if image not in found.topics:
        yield Finding("error", topic, f"labels without any image on {image}")
        return
    times = read_table(path, image, fields=[])["log_time"]
    alone = pc.sum(pc.invert(pc.is_in(table["log_time"], times))).as_py()
    if alone:
        yield Finding(
            "error", topic, f"{alone} of {table.num_rows} messages have no image at their time"
        )


def _bounds(path: Path, found: Summary, robot: str) -> tuple[int, int] | None:
    """Width and height of the robot's images, from the calibration or the first image."""
    if _count(found, calibration(robot)):
        known = next(columns(path, calibration(robot), fields=["width", "height"]))
        return known["width"][0].as_py(), known["height"][0].as_py()
    if not _count(found, camera_image(robot)):
        return None
    image = next(columns(path, camera_image(robot), fields=["data"]))
    try:
        width_px, height_px, _ = size(image["data"][0].as_py())
    except (DmrlError, ValueError):
        return None  # said already
    return width_px, height_px


def _count(found: Summary, topic: str) -> int:
    return found.topics[topic].count if topic in found.topics else 0


def _values(
    topic: str, source: str, peers: pa.Table, bounds: tuple[int, int] | None
) -> Iterator[Finding]:
    uv = np.column_stack([peers["u_px"].to_numpy(), peers["v_px"].to_numpy()])
    depth_m = peers["depth_m"].to_numpy()
    wrong = int((~np.isfinite(uv).all(axis=1) | ~np.isfinite(depth_m) | (depth_m <= 0)).sum())
    if wrong:
        yield Finding(
            "error",
            topic,
            f"{wrong} labels of source {source!r} have no pixel, or a depth not above 0",
        )
    if bounds is not None and (outside := int((~inside(uv, *bounds)).sum())):
        yield Finding(
            "warning",
            topic,
            f"{outside} of {len(uv)} labels of source {source!r} lie outside the "
            f"{bounds[0]}x{bounds[1]} image",
        )


def _bias(
    topic: str, source: str, peers: pa.Table, bounds: tuple[int, int] | None
) -> Iterator[Finding]:
    """Labels that lie beside the middle of their boxes, all the same way."""
    boxed = peers.filter(pc.equal(pc.list_value_length(peers["box_px"]), 4))
    if bounds is None or boxed.num_rows < BIAS_MIN_LABELS:
        return
    box = pc.list_flatten(boxed["box_px"]).to_numpy().reshape(-1, 4)
    low, high = box[:, :2], box[:, 2:]
    whole = (low > BORDER_PX).all(axis=1) & (high < np.array(bounds) - BORDER_PX).all(axis=1)
    if whole.sum() < BIAS_MIN_LABELS:
        return
    uv = np.column_stack([boxed["u_px"].to_numpy(), boxed["v_px"].to_numpy()])
    offset = (uv - (low + high) / 2)[whole]
    middle = np.median(offset, axis=0)
    # Standard error of a median, with the spread taken robustly from the MAD.
    sigma = 1.4826 * np.median(np.abs(offset - middle), axis=0)
    error = 1.2533 * sigma / np.sqrt(len(offset))
    if ((np.abs(middle) > BIAS_MIN_PX) & (np.abs(middle) > BIAS_MIN_SIGMAS * error)).any():
        yield Finding(
            "warning",
            topic,
            f"labels of source {source!r} are biased: {middle[0]:+.1f} px in u and "
            f"{middle[1]:+.1f} px in v beside the middle of their boxes "
            f"(median of {len(offset)}, standard error {error[0]:.2f} and {error[1]:.2f} px)",
        )
