"""Faint detections: peaks of maps below the threshold of `dmrl predict`."""

from typing import Any

import numpy as np
import pytest

from dmrl.viewer.content.faint_detections import find_faint

ROWS, COLS = 4, 6


def make_grid(**changed: Any) -> dict[str, Any]:
    """Return the fields of a map with peaks of 0.9, 0.004 and 0.0004."""
    cells = np.zeros((2, ROWS, COLS), "<f4")
    cells[0, 1, 1], cells[0, 3, 4], cells[0, 0, 5] = 0.9, 0.004, 0.0004
    cells[1] = 1.5
    fields = {"rows": ROWS, "cols": COLS, "channels": ["confidence", "depth_m"], "stride_px": 8}
    return fields | {"data": cells.tobytes()} | changed


@pytest.mark.parametrize("stride_px", [8, 0])
def test_peaks_that_no_detection_has_are_found(stride_px: int) -> None:
    told = [{"u_px": 15.0, "v_px": 14.0, "depth_m": 1.4, "confidence": 0.9}]
    (faint,) = find_faint(make_grid(stride_px=stride_px), told)
    assert faint == pytest.approx({"u_px": 36, "v_px": 28, "depth_m": 1.5, "confidence": 0.004})
    assert len(find_faint(make_grid(), [])) == 2


@pytest.mark.parametrize(
    "changed",
    [
        {"data": b""},
        {"data": b"\0" * 7},
        {"rows": 2**31, "cols": 2**31},
        {"channels": ["confidence"]},
        {"channels": ["depth_m", "spread"]},
        {"data": np.full(2 * ROWS * COLS, np.nan, "<f4").tobytes()},
    ],
)
def test_a_map_that_does_not_fit_has_no_peaks(changed: dict[str, Any]) -> None:
    assert find_faint(make_grid(**changed), []) == []
    assert find_faint({}, []) == []
