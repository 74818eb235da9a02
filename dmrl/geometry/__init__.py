"""Coordinate frames, lens distortion and the camera file."""
