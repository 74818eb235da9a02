"""Kalman filters of a pair and an Ornstein-Uhlenbeck smoother."""
