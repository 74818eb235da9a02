"""Relative positions of two robots from ranges, velocities and yaw rates. Arrays only.

Frames and signs are those of ``geometry``: horizontal has x forward, y left, z up. The state
is (x, y, psi): where the peer is in the observer's horizontal frame, and its heading there.
"""
