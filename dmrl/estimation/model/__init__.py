"""Measurement models of a pair: odometry, bearings, position metrics and status."""
