"""Inference: load a model, decode its grids, match detections, set the threshold."""
