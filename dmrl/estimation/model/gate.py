"""Error at which an estimated position is bad. Imports nothing heavy: help shows the value."""

GATE_M = 0.3
"""Default of the largest horizontal error of a good position, metres. No record of how the value
was chosen."""
