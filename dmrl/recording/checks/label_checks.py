"""Check the labels of a recording."""

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dmrl.errors import RecordingError
from dmrl.geometry.frames import inside
from dmrl.recording.checks.finding import Finding
from dmrl.recording.checks.scan import Seen, first_size
from dmrl.topics import LABELS, calibration, camera_image, names

BIAS_MIN_LABELS = 20
"""Labels with boxes that are needed to measure a bias."""
BIAS_MIN_PX = 1.5
"""Smallest bias that is reported, pixels.

A true centre is not exactly the middle of its box. In the published renders, labelled with the
true projection, the offset is 0.6 px.
"""
BIAS_MIN_SIGMAS = 5.0
"""Smallest bias that is reported, in standard errors."""
BORDER_PX = 1.0
"""Distance from the image border below which a box counts as cropped, pixels."""


def labels(seen: Seen) -> Iterator[Finding]:
    """Report labels without image, outside the image, with impossible values, or biased."""
    found = seen.contents.topics
    for topic in found:
        parts = names(LABELS, topic)
        if parts is None or topic in seen.broken or found[topic].schema != "dmrl.v1.PeerLabels":
            continue
        try:
            table = seen.contents.table(topic)
        except RecordingError as e:
            yield Finding("error", topic, str(e))
            continue
        yield from _without_image(seen, topic, camera_image(parts["robot"]), table)
        peers = _flat(table["peers"])
        bounds = _bounds(seen, parts["robot"])
        for source in sorted(set(peers["source"].to_pylist())):
            of_source = peers.filter(pc.equal(peers["source"], source))
            yield from _values(topic, source, of_source, bounds)
            yield from _bias(topic, source, of_source, bounds)


def _without_image(seen: Seen, topic: str, image: str, table: pa.Table) -> Iterator[Finding]:
    if image not in seen.times:
        yield Finding("error", topic, f"labels without any image on {image}")
        return
    alone = int((~np.isin(table["log_time"].to_numpy(), seen.times[image])).sum())
    if alone:
        yield Finding(
            "error", topic, f"{alone} of {table.num_rows} messages have no image at their time"
        )


def _bounds(seen: Seen, robot: str) -> tuple[int, int] | None:
    """Return width and height of the robot's images, from the calibration or the first image."""
    topic, image = calibration(robot), camera_image(robot)
    if len(seen.times.get(topic, ())):
        known = seen.contents.table(topic, ["width", "height"])
        return known["width"][0].as_py(), known["height"][0].as_py()
    return first_size(seen, image) if image in seen.times else None


def _flat(peers: pa.ChunkedArray) -> pa.Table:
    """Return a table with one row per peer and source."""
    flat = pc.list_flatten(peers)
    return pa.table({f.name: pc.struct_field(flat, f.name) for f in flat.type})


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
            f"{wrong} labels of source {source!r} have no pixel, or a depth that is not positive",
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
    """Report labels with a common offset from the middle of their boxes."""
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
