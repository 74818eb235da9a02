"""Rendering of labelled images of robots from their poses."""
