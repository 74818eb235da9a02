"""Recipes that ship with dmrl: TOML files, each runnable as it stands."""
