"""Evaluate detections, positions and tracks against the ground truth."""
