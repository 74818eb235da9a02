"""The robots that dmrl draws, by name."""

from collections.abc import Mapping

from dmrl.rendering.crazyflie import CRAZYFLIE
from dmrl.rendering.solids import Design
from dmrl.rendering.violet import VIOLET

DESIGNS: Mapping[str, Design] = {"crazyflie": CRAZYFLIE, "violet": VIOLET}
