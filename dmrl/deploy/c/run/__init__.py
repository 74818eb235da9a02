"""Compile, emulate and verify the generated C, and count its instructions."""
