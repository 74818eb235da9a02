"""All faults that are injected into recordings of sound flights.

Signals, sizes and seeds were fixed on 25 November 2026, before model selection by evidence was
tuned.
"""

from label_judge.flow_rows import FLOW_ROWS
from label_judge.injection import Row
from label_judge.other_rows import OTHER_ROWS
from label_judge.range_rows import RANGE_ROWS
from label_judge.yaw_rows import YAW_ROWS

ROWS: tuple[Row, ...] = (*YAW_ROWS, *FLOW_ROWS, *RANGE_ROWS, *OTHER_ROWS)
"""All faults of the table."""
