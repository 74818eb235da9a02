"""The live view of a recording session, read back from an .rrd file."""

from collections import Counter
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.chunk import RrdReader

from dmrl.images.codec import encode_png
from dmrl.live.queue import ReceivedSample
from dmrl.samples.flight import iter_ranges
from dmrl.samples.sample import Sample, build_image
from dmrl.viewer.window.live_view import LiveView, build_layout

MS = 1_000_000
BASE_NS = 1_700_000_000_000_000_000


def test_pictures_are_all_shown_and_curves_ten_times_a_second(tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    stream = rr.RecordingStream("test")
    stream.save(path, default_blueprint=build_layout(["cf1", "cf2"], ["cf1"]))
    view = LiveView(stream)
    png = encode_png(np.zeros((8, 8, 3), np.uint8))
    for k in range(100):
        time_ns = BASE_NS + 10 * MS * k
        samples = [
            Sample(time_ns, "/cf1/height", "Height", {"height_m": 1.0}),
            Sample(time_ns, "/cf1/velocity", "Velocity", {"vx_mps": 3.0, "vy_mps": 4.0}),
            Sample(time_ns, "/cf1/attitude", "Attitude", {}),
            *iter_ranges("cf1", "cf2", np.array([time_ns]), np.array([2.0])),
        ]
        if k % 5 == 0:
            samples.append(build_image(time_ns, "cf1", png, "png"))
        for sample in samples:
            view.show(ReceivedSample(sample, time_ns))
    stream.flush()
    stream.disconnect()
    rows: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            rows[str(chunk.entity_path)] += chunk.num_rows
    assert rows == {
        "/cf1/camera/image": 20,
        "/cf1/height": 10,
        "/cf1/velocity": 10,
        "/cf1/range/cf2": 10,
    }
