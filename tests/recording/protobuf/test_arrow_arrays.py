"""Conversion between NumPy and Arrow: equal values, without loading pandas."""

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from dmrl.recording.protobuf.arrow_arrays import match_text, to_arrow, to_numpy

VALUES = [
    np.array([True, False, True] * 5),
    np.arange(9, dtype=np.int32),
    np.arange(12.0)[::3],
    np.zeros(0),
    np.zeros(0, bool),
]
WITHOUT_PANDAS = """
import sys
import numpy as np
from dmrl.recording.protobuf.arrow_arrays import to_arrow, to_numpy
for values in (np.arange(3.0), np.array([True, False])):
    to_numpy(to_arrow(values))
sys.exit("pandas" in sys.modules)
"""


@pytest.mark.parametrize("values", VALUES, ids=lambda values: f"{values.dtype}-{len(values)}")
def test_converted_values_equal_those_of_pyarrow(values: NDArray[np.generic]) -> None:
    column = to_arrow(values)
    assert column.equals(pa.array(values))
    for back in (to_numpy(column), to_numpy(pa.chunked_array([column]))):
        assert back.dtype == values.dtype
        assert back.tolist() == values.tolist()
    assert to_numpy(column.slice(1)).tolist() == values[1:].tolist()
    assert to_numpy(pa.chunked_array([column, column])).tolist() == values.tolist() * 2


def test_null_numbers_are_nan() -> None:
    assert to_numpy(pa.array([1.0, None]))[0] == 1
    assert np.isnan(to_numpy(pa.array([1.0, None]))[1])
    assert np.isnan(to_numpy(pa.array([1, None]))[1])


def test_match_text_finds_equal_texts() -> None:
    texts = pa.array(["motion", "", "mo", "motion"])
    assert match_text(texts, "motion").tolist() == [True, False, False, True]
    assert match_text(pa.chunked_array([texts]), "").tolist() == [False, True, False, False]


@pytest.mark.heavy
def test_pandas_is_not_loaded() -> None:
    assert subprocess.run([sys.executable, "-c", WITHOUT_PANDAS], check=False).returncode == 0
