"""Simulation of flights: motion of robots and measurements of their sensors, as arrays.

``simulate(scenario, noise, seed, faults)`` returns every robot's log, the ranges between robots
and the ground truth. A robot's randomness depends only on the seed and its number. Adding robots
does not change the others.
"""

from dmrl.flight.faults import Fault
from dmrl.flight.flight_arrays import Clock, Flight, Ranges, RobotLog, Truth
from dmrl.flight.noise import NOISE, Noise
from dmrl.flight.plan import Scenario
from dmrl.flight.stepped import simulate
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
