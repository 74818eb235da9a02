"""The simulated camera: lens, sensor, noise and image statistics."""
