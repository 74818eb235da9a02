"""Poses in, pixels out."""
