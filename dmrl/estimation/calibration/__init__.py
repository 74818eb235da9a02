"""Calibrate cameras: intrinsics, mount and delay."""
