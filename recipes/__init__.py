"""Recipes for users that ship with dmrl: TOML files, each runnable as it is."""
