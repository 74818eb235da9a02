"""Estimate a whole flight: initial guesses, solutions, windows and the swarm."""
