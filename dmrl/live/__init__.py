"""Robots on the network: links, cameras and their clocks; and drones that are not there.

Samples come out and flights go in as arrays: nothing here knows recordings.
"""
