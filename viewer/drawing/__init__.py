"""Draw messages as rerun archetypes."""
