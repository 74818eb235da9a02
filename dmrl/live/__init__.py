"""Robots on the network: links, cameras and clocks, and simulated drones for trials.

Links yield samples, and simulated drones take flights as arrays: this package reads no recordings.
"""
