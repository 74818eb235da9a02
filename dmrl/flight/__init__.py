"""Simulated flights: how robots move, and what their sensors make of it. Arrays only.

``simulate(scenario, noise, seed, faults)`` gives every robot's log, the ranges between them and
the truth. A robot's own randomness depends on the seed and its number alone, so adding robots
changes nothing for those already there.
"""

from dmrl.flight.faults import Fault
from dmrl.flight.flight_arrays import Clock, Flight, Ranges, RobotLog, Truth
from dmrl.flight.noise import NOISE, Noise
from dmrl.flight.simulate import Scenario, simulate
from dmrl.flight.trajectories import TRAJECTORIES, Trajectory

__all__ = [
    "NOISE",
    "TRAJECTORIES",
    "Clock",
    "Fault",
    "Flight",
    "Noise",
    "Ranges",
    "RobotLog",
    "Scenario",
    "Trajectory",
    "Truth",
    "simulate",
]
