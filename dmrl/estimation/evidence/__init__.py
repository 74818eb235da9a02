"""Posterior over error models of a flight, their causes in words, and the goodness of fit."""
