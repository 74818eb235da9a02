"""Simulated flights and pictures: from Python, as recordings, as folders, and as drones send them.

`Simulation` flies robots by commands, step by step: ``reset(seed)``, ``step(commands)``.
"""

from typing import TYPE_CHECKING

from dmrl.guards.lazy_names import import_lazily

if TYPE_CHECKING:
    from dmrl.flight.pilot import Command as Command
    from dmrl.flight.pilot import Observation as Observation
    from dmrl.simulation.simulator import Simulation as Simulation

__getattr__ = import_lazily(
    __name__,
    {
        "Command": "dmrl.flight.pilot",
        "Observation": "dmrl.flight.pilot",
        "Simulation": "dmrl.simulation.simulator",
    },
)
