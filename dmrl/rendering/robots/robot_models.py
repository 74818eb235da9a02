"""Registry of the built-in robot models."""

from collections.abc import Mapping

from dmrl.rendering.robots.crazyflie import CRAZYFLIE
from dmrl.rendering.robots.primitives import RobotDesign
from dmrl.rendering.robots.violet import VIOLET

DESIGNS: Mapping[str, RobotDesign] = {"crazyflie": CRAZYFLIE, "violet": VIOLET}
