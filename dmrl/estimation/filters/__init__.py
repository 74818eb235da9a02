"""Kalman filters of a pair."""
