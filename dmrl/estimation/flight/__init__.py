"""Estimate a whole flight: initial guesses, solutions, segments and the swarm."""
