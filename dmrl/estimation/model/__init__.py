"""Measurement models: odometry, bearings, the pair and its status."""
