"""Relative positions from ranges, velocities and yaw rates; clocks, tracks, calibration. No files.

Arrays in, arrays out: nothing here knows recordings.

Frames and signs are those of ``geometry``: horizontal has x forward, y left, z up. The state
is (x, y, psi): where the peer is in the observer's horizontal frame, and its heading there.
"""
