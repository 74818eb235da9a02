"""Simulated flights and pictures: as recordings, as folders, and as drones send them."""
