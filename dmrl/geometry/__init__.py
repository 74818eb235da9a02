"""Frames, lenses and the camera file."""
