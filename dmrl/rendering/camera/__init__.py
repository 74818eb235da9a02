"""Simulated camera: lens, sensor, noise and image statistics."""
