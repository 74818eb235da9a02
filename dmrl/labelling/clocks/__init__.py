"""Clocks of robots and cameras: estimated, aligned, and applied to a recording."""
