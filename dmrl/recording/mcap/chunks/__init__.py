"""Chunks of MCAP files: parsed, read, built and written."""
