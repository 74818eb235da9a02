"""Detections, positions and tracks, joined with the ground truth and judged."""
