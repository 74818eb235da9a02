"""Columns of samples, compared with the same samples one by one."""

from itertools import pairwise

import numpy as np
import pytest

from dmrl.errors import SourceError
from dmrl.messages import LogType, message_class
from dmrl.recording.protobuf.encode import encode
from dmrl.samples.flight import to_nanoseconds
from dmrl.samples.sample import Columns

TIMES_NS = np.arange(4) * 10
POSE = {
    "timestamp": {"seconds": np.arange(4), "nanos": np.arange(4)[::-1]},
    "frame_id": "world",
    "pose": {"position": {"x": np.linspace(-1, 1, 4)}},
}
KIND = LogType("a", (("b.b", "b"), ("h.h", "h"), ("i.i", "i"), ("u.u", "I"), ("e.e", "e")))
LOGGED = {
    "b_b": np.array([-128, -1, 0, 127], np.int8),
    "h_h": np.array([-32768, 0, 1, 32767], np.int16),
    "i_i": np.array([-(2**31), -2, 0, 2**31 - 1], np.int32),
    "u_u": np.array([0, 1, 2**31, 2**32 - 1], np.uint32),
    "e_e": np.array([0, -0.0, 0.5, np.nan], np.float16),
}


@pytest.mark.parametrize(
    "columns",
    [Columns("/a", "PoseInFrame", TIMES_NS, POSE), Columns("/b", KIND, TIMES_NS, LOGGED)],
    ids=["nested", "logged"],
)
def test_columns_encode_to_the_bytes_of_single_samples(columns: Columns) -> None:
    kind = message_class(columns.message)
    rows = [kind(**sample.fields).SerializeToString() for sample in columns]
    data, at = encode(kind.DESCRIPTOR, columns.fields, len(TIMES_NS))
    assert rows == [data[a:b].tobytes() for a, b in pairwise(at)]


def test_cropping_to_a_time_crops_nested_columns() -> None:
    part = Columns("/a", "PoseInFrame", TIMES_NS, POSE).crop_to_time(10, 30)
    assert part.time_ns.tolist() == [10, 20]
    assert [sample.fields["timestamp"]["seconds"] for sample in part] == [1, 2]


def test_an_event_without_variables_is_kept() -> None:
    columns = Columns("/c", LogType("c", ()), TIMES_NS, {})
    assert [sample.fields for sample in columns] == [{}] * 4


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1e10])
def test_the_row_of_an_invalid_time_is_named(wrong: float) -> None:
    times = np.array([0.0, 1.5, wrong, np.nan])
    assert to_nanoseconds(times[:2]).tolist() == [0, 1_500_000_000]
    with pytest.raises(SourceError, match=r"a\.log: time (nan|inf|-1e\+10) s in row 2\."):
        to_nanoseconds(times, "a.log")
