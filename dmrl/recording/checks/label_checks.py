"""Check the labels of a recording."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from dmrl.errors import RecordingError
from dmrl.geometry.frames import Array, is_inside
from dmrl.recording.checks.scan import CheckData, Finding, find_first_size
from dmrl.recording.protobuf.arrow_arrays import match_text, to_arrow, to_numpy
from dmrl.topics import CALIBRATION, CAMERA_IMAGE, CAUSES, DETECTIONS, LABELS, parse_topic

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
        peers = pa.Table.from_struct_array(pc.list_flatten(table["peers"]))
        size_px = _find_image_size(data, parts["robot"])
        for source in sorted(set(peers["source"].to_pylist())):
            mine = peers.filter(to_arrow(match_text(peers["source"], source)))
            labels = _build_labels(source, mine, size_px)
            yield from (Finding("error", topic, text) for text in _check_pixels(labels))
            for rule in (_check_plausibility, _check_boxes):
                yield from (Finding("warning", topic, text) for text in rule(labels))


@dataclass(frozen=True, slots=True)
class _Labels:
    """Labels of one source.

    Parameters
    ----------
    name
        Words for them.
    uv, depth_m, has_depth
        (N, 2) pixels, (N,) depths, and whether each is known.
    has_box, box
        (N,) whether a label has a box, and (K, 4) the boxes.
    size_px
        Width and height of the images; None: unknown.
    """

    name: str
    uv: Array
    depth_m: Array
    has_depth: NDArray[np.bool_]
    has_box: NDArray[np.bool_]
    box: Array
    size_px: tuple[int, int] | None


def _build_labels(source: str, peers: pa.Table, size_px: tuple[int, int] | None) -> _Labels:
    has_box = to_numpy(pc.list_value_length(peers["box_px"])) == 4
    return _Labels(
        f"labels of source {source!r}",
        np.column_stack([to_numpy(peers["u_px"]), to_numpy(peers["v_px"])]),
        to_numpy(peers["depth_m"]),
        ~np.isinf(to_numpy(peers["sigma_depth_m"])),
        has_box,
        to_numpy(pc.list_flatten(peers.filter(to_arrow(has_box))["box_px"])).reshape(-1, 4),
        size_px,
    )


def check_causes(data: CheckData) -> Iterator[Finding]:
    """Report the errors of sensors that `dmrl label` found, most probable first."""
    found: dict[str, tuple[float, str]] = {}
    for topic in data.contents.topics:
        parts = parse_topic(CAUSES, topic)
        if parts is None or topic in data.broken:
            continue
        for causes in data.contents.get_table(topic)["causes"].to_pylist():
            for one in causes:
                owner = f"{one['robot']}'s " if one["robot"] else ""
                span = f"{one['from_s']:.0f} to {one['to_s']:.0f} s"
                text = f"{owner}{one['name']}, {one['probability']:.0%}, {span}"
                both = "-".join(sorted(parts.values()))
                # Both directions of a pair have the same causes.
                found.setdefault(f"{both}: {text}", (one["probability"], topic))
    for text, (_, topic) in sorted(found.items(), key=lambda item: -item[1][0]):
        yield Finding("warning", topic, text)


def _check_images(data: CheckData, topic: str, image: str, table: pa.Table) -> Iterator[Finding]:
    if image not in data.times:
        # A simulated camera may give its detections and labels without images.
        if not any(parse_topic(DETECTIONS, name) for name in data.times):
            yield Finding("error", topic, f"labels without any image on {image}")
        return
    images_ns = np.concatenate([*data.image_times_ns[image], np.empty(0, np.int64)])
    alone = int((~np.isin(to_numpy(table["log_time"]), images_ns)).sum())
    if alone:
        text = f"{alone} of {table.num_rows} messages have no image at their time"
        yield Finding("error", topic, text)


def _find_image_size(data: CheckData, robot: str) -> tuple[int, int] | None:
    """Return width and height of the robot's images, from the calibration or the first image."""
    topic, image = CALIBRATION(robot), CAMERA_IMAGE(robot)
    if len(data.times.get(topic, ())):
        calibrated = data.contents.get_table(topic, ["width", "height"])
        return calibrated["width"][0].as_py(), calibrated["height"][0].as_py()
    return find_first_size(data, image) if image in data.times else None


def _check_pixels(labels: _Labels) -> Iterator[str]:
    """Report labels without a pixel, or with an impossible depth."""
    bad_depth = labels.has_depth & (~np.isfinite(labels.depth_m) | (labels.depth_m <= 0))
    if wrong := int((~np.isfinite(labels.uv).all(axis=1) | bad_depth).sum()):
        yield f"{wrong} {labels.name} have no pixel, or a depth that is not positive"


def _check_plausibility(labels: _Labels) -> Iterator[str]:
    """Report labels outside the image, or in the wrong unit."""
    uv, size_px = labels.uv, labels.size_px
    if size_px and (outside := int((~is_inside(uv, *size_px)).sum())):
        size = "{}x{}".format(*size_px)
        yield f"{outside} of {len(uv)} {labels.name} lie outside the {size} image"
    if len(uv) < DOUBT_LABELS_MIN:
        return
    if size_px and ((uv >= 0) & (uv <= 1)).all():
        yield f"{labels.name} all lie in the first pixel. Are they normalised?"
    if (depth_m := float(np.median(labels.depth_m))) > DEPTH_MAX_M:
        yield f"{labels.name} have a median depth of {depth_m:.0f} m. Is it in mm?"


def _check_boxes(labels: _Labels) -> Iterator[str]:
    """Report boxes without area; else a bias; else centres that are not in their boxes."""
    box, uv = labels.box, labels.uv[labels.has_box]
    outside = (uv < box[:, :2]).any(axis=1) | (uv > box[:, 2:]).any(axis=1)
    empty = (box[:, 2:] <= box[:, :2]).any(axis=1)
    of = f"{len(box)} {labels.name}"
    if len(box) >= BIAS_LABELS_MIN and empty.mean() > OUTSIDE_BOX_SHARE:
        text = f"{int(empty.sum())} of {of} have boxes without area"
        yield f"{text}. Are they left, top, right, bottom?"
    elif biased := _describe_bias(labels):
        yield biased
    elif len(box) >= BIAS_LABELS_MIN and outside.mean() > OUTSIDE_BOX_SHARE:
        yield f"{int(outside.sum())} of {of} have their centre outside their box"


def _describe_bias(labels: _Labels) -> str:
    """Return the words for a common offset from the middle of the boxes; empty if none."""
    if labels.size_px is None or len(labels.box) < BIAS_LABELS_MIN:
        return ""
    low, high = labels.box[:, :2], labels.box[:, 2:]
    whole = (low > BORDER_MARGIN_PX).all(axis=1) & (
        high < np.array(labels.size_px) - BORDER_MARGIN_PX
    ).all(axis=1)
    if whole.sum() < BIAS_LABELS_MIN:
        return ""
    offset = (labels.uv[labels.has_box] - (low + high) / 2)[whole]
    middle = np.median(offset, axis=0)
    # Standard error of a median; the spread is estimated robustly from the MAD.
    sigma = 1.4826 * np.median(np.abs(offset - middle), axis=0)
    error = 1.2533 * sigma / np.sqrt(len(offset))
    if not ((np.abs(middle) > BIAS_MIN_PX) & (np.abs(middle) > BIAS_MIN_SIGMAS * error)).any():
        return ""
    return (
        f"{labels.name} are biased: {middle[0]:+.1f} px in u and {middle[1]:+.1f} px in v from the "
        f"middle of their boxes (median of {len(offset)}, standard error {error[0]:.2f} and "
        f"{error[1]:.2f} px)"
    )
