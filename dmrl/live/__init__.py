"""Robots on the network: links, cameras and their clocks; and simulated drones to try them with.

Samples come out and flights go in as arrays: nothing here knows recordings.
"""
