"""Track detected peers over time."""
