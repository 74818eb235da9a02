"""Faults that are injected into the recordings of sound flights, from outside of every model.

Signals, sizes and seeds were fixed on 25 November 2026, before labels by evidence were tuned.
"""

from label_judge.flow_rows import FLOW_ROWS
from label_judge.injection import Row
from label_judge.other_rows import OTHER_ROWS
from label_judge.range_rows import RANGE_ROWS
from label_judge.yaw_rows import YAW_ROWS

ROWS: tuple[Row, ...] = (*YAW_ROWS, *FLOW_ROWS, *RANGE_ROWS, *OTHER_ROWS)
"""Faults of the table."""
