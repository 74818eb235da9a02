"""Check the labels of a recording."""

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dmrl.errors import RecordingError
from dmrl.geometry.frames import is_inside
from dmrl.recording.checks.finding import Finding
from dmrl.recording.checks.scan import CheckData, find_first_size
from dmrl.topics import CALIBRATION, CAMERA_IMAGE, DETECTIONS, LABELS, parse_topic

BIAS_LABELS_MIN = 20
"""Labels with boxes that are needed to measure a bias."""
BIAS_MIN_PX = 1.5
"""Smallest bias that is reported, pixels.

A true centre is not exactly the middle of its box. In the published renders, labelled with the
true projection, the offset is 0.6 px.
"""
BIAS_MIN_SIGMAS = 5.0
"""Smallest bias that is reported, in standard errors."""
DOUBT_LABELS_MIN = 5
"""Labels needed to doubt their units."""
DEPTH_MAX_M = 50.0
"""Largest plausible median depth, metres: a robot of 0.1 m is half a pixel there."""
OUTSIDE_BOX_SHARE = 0.1
"""Share of the centres outside their boxes from which to report."""
BORDER_MARGIN_PX = 1.0
"""Distance from the image border below which a box counts as cropped, pixels."""


def check_labels(data: CheckData) -> Iterator[Finding]:
    """Report labels without image, outside the image, with impossible values, or biased."""
    topics = data.contents.topics
    for topic in topics:
        parts = parse_topic(LABELS, topic)
        if parts is None or topic in data.broken or topics[topic].schema != "dmrl.v1.PeerLabels":
            continue
        try:
            table = data.contents.get_table(topic)
        except RecordingError as e:
            yield Finding("error", topic, str(e))
            continue
        yield from _check_images(data, topic, CAMERA_IMAGE(parts["robot"]), table)
        peers = _flatten_peers(table["peers"])
        bounds = _find_image_size(data, parts["robot"])
        for source in sorted(set(peers["source"].to_pylist())):
            source_labels = peers.filter(pc.equal(peers["source"], source))
            yield from _check_values(topic, source, source_labels, bounds)
            yield from _check_plausibility(topic, source, source_labels, bounds)
            biased = [*_check_bias(topic, source, source_labels, bounds)]
            yield from _check_boxes(topic, source, source_labels, biased)


def _check_images(data: CheckData, topic: str, image: str, table: pa.Table) -> Iterator[Finding]:
    if image not in data.times:
        # A simulated camera may give its detections and labels without images.
        if not any(parse_topic(DETECTIONS, name) for name in data.times):
            yield Finding("error", topic, f"labels without any image on {image}")
        return
    without_image = int((~np.isin(table["log_time"].to_numpy(), data.times[image])).sum())
    if without_image:
        yield Finding(
            "error",
            topic,
            f"{without_image} of {table.num_rows} messages have no image at their time",
        )


def _find_image_size(data: CheckData, robot: str) -> tuple[int, int] | None:
    """Return width and height of the robot's images, from the calibration or the first image."""
    topic, image = CALIBRATION(robot), CAMERA_IMAGE(robot)
    if len(data.times.get(topic, ())):
        calibrated = data.contents.get_table(topic, ["width", "height"])
        return calibrated["width"][0].as_py(), calibrated["height"][0].as_py()
    return find_first_size(data, image) if image in data.times else None


def _flatten_peers(peers: pa.ChunkedArray) -> pa.Table:
    """Return a table with one row per peer and source."""
    flat = pc.list_flatten(peers)
    return pa.table({f.name: pc.struct_field(flat, f.name) for f in flat.type})


def _check_values(
    topic: str, source: str, peers: pa.Table, image_size: tuple[int, int] | None
) -> Iterator[Finding]:
    uv = np.column_stack([peers["u_px"].to_numpy(), peers["v_px"].to_numpy()])
    depth_m = peers["depth_m"].to_numpy()
    known = ~np.isinf(peers["sigma_depth_m"].to_numpy())
    bad_depth = known & (~np.isfinite(depth_m) | (depth_m <= 0))
    wrong = int((~np.isfinite(uv).all(axis=1) | bad_depth).sum())
    if wrong:
        yield Finding(
            "error",
            topic,
            f"{wrong} labels of source {source!r} have no pixel, or a depth that is not positive",
        )
    if image_size is not None and (outside := int((~is_inside(uv, *image_size)).sum())):
        yield Finding(
            "warning",
            topic,
            f"{outside} of {len(uv)} labels of source {source!r} lie outside the "
            f"{image_size[0]}x{image_size[1]} image",
        )


def _check_plausibility(
    topic: str, source: str, peers: pa.Table, image_size: tuple[int, int] | None
) -> Iterator[Finding]:
    """Report labels in the wrong unit."""
    uv = np.column_stack([peers["u_px"].to_numpy(), peers["v_px"].to_numpy()])
    if len(uv) < DOUBT_LABELS_MIN:
        return
    of = f"labels of source {source!r}"
    if image_size is not None and ((uv >= 0) & (uv <= 1)).all():
        yield Finding("warning", topic, f"{of} all lie in the first pixel. Are they normalised?")
    if (depth_m := float(np.median(peers["depth_m"].to_numpy()))) > DEPTH_MAX_M:
        text = f"{of} have a median depth of {depth_m:.0f} m. Is it in mm?"
        yield Finding("warning", topic, text)


def _check_boxes(
    topic: str, source: str, peers: pa.Table, biased: list[Finding]
) -> Iterator[Finding]:
    """Report boxes without area; else a bias; else centres that are not in their boxes."""
    uv = np.column_stack([peers["u_px"].to_numpy(), peers["v_px"].to_numpy()])
    has_box = pc.equal(pc.list_value_length(peers["box_px"]), 4).to_numpy()
    box = pc.list_flatten(peers.filter(pa.array(has_box))["box_px"]).to_numpy().reshape(-1, 4)
    outside = (uv[has_box] < box[:, :2]).any(axis=1) | (uv[has_box] > box[:, 2:]).any(axis=1)
    empty = (box[:, 2:] <= box[:, :2]).any(axis=1)
    of = f"{len(box)} labels of source {source!r}"
    if len(box) >= BIAS_LABELS_MIN and empty.mean() > OUTSIDE_BOX_SHARE:
        text = f"{int(empty.sum())} of {of} have boxes without area"
        yield Finding("warning", topic, f"{text}. Are they left, top, right, bottom?")
    elif biased:
        yield from biased
    elif len(box) >= BIAS_LABELS_MIN and outside.mean() > OUTSIDE_BOX_SHARE:
        text = f"{int(outside.sum())} of {of} have their centre outside their box"
        yield Finding("warning", topic, text)


def _check_bias(
    topic: str, source: str, peers: pa.Table, image_size: tuple[int, int] | None
) -> Iterator[Finding]:
    """Report labels with a common offset from the middle of their boxes."""
    labels_with_box = peers.filter(pc.equal(pc.list_value_length(peers["box_px"]), 4))
    if image_size is None or labels_with_box.num_rows < BIAS_LABELS_MIN:
        return
    box = pc.list_flatten(labels_with_box["box_px"]).to_numpy().reshape(-1, 4)
    low, high = box[:, :2], box[:, 2:]
    whole = (low > BORDER_MARGIN_PX).all(axis=1) & (
        high < np.array(image_size) - BORDER_MARGIN_PX
    ).all(axis=1)
    if whole.sum() < BIAS_LABELS_MIN:
        return
    uv = np.column_stack([labels_with_box["u_px"].to_numpy(), labels_with_box["v_px"].to_numpy()])
    offset = (uv - (low + high) / 2)[whole]
    middle = np.median(offset, axis=0)
    # Standard error of a median; the spread is estimated robustly from the MAD.
    sigma = 1.4826 * np.median(np.abs(offset - middle), axis=0)
    error = 1.2533 * sigma / np.sqrt(len(offset))
    if ((np.abs(middle) > BIAS_MIN_PX) & (np.abs(middle) > BIAS_MIN_SIGMAS * error)).any():
        yield Finding(
            "warning",
            topic,
            f"labels of source {source!r} are biased: {middle[0]:+.1f} px in u and "
            f"{middle[1]:+.1f} px in v from the middle of their boxes "
            f"(median of {len(offset)}, standard error {error[0]:.2f} and {error[1]:.2f} px)",
        )
