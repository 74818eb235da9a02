"""Detections, positions and tracks, joined with what is true and judged."""
