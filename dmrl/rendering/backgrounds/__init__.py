"""Backgrounds of rendered images: photos, panoramas, generated rooms and textures."""
