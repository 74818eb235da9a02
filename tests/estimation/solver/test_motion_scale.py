"""A scale of a robot's motion also applies between a keyframe and a measurement."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.estimation.solver.residuals import Rows, Values, bearing_factor, range_factor

from .test_residuals import build_flight


@pytest.mark.parametrize("side", [0, 1])
def test_measurements_between_keyframes_take_the_scale_of_the_motion(side: int) -> None:
    """Motion logged 1.25 times too long, with that scale, leaves the residuals unchanged."""
    problem, values = build_flight()
    name = ("own_shift_m", "peer_shift_m")[side]

    def residuals(factor: float) -> np.ndarray:
        out: list[Rows] = []
        for measured, linearize in (
            (problem.links[0], range_factor),
            (problem.views[0], bearing_factor),
        ):
            constants = values.constants.copy()
            for robot in (0, 1):
                constants[problem.layout.find("velocity_scale", robot)] = 0.0
            robot = measured.robots[side]
            constants[problem.layout.find("velocity_scale", robot)] = factor - 1
            logged = replace(measured, **{name: factor * getattr(measured, name)})
            at = Values(values.state, constants)
            out.append(linearize(problem, problem.layout, logged, at))  # type: ignore[arg-type]
        return np.concatenate([one.rows[..., -1].ravel() for one in out])

    assert np.abs(getattr(problem.links[0], name)).max() > 0.01
    assert residuals(1.25) == pytest.approx(residuals(1.0))
