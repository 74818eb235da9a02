"""Estimate every pair of a flight: initial guesses, multi-start, data association."""
