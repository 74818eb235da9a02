"""Backgrounds of rendered images: photos, rooms and environments."""
