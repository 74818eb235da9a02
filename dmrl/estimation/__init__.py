"""Estimate relative positions, clocks, tracks and camera calibrations from arrays.

No module here reads or writes files, and none imports the recording package.

Frames and signs are those of ``geometry``: the horizontal frame has x forward, y left, z up. The
state of a pair is (x, y, psi): position and heading of the peer in the observer's horizontal frame.
"""
