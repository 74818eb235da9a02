"""The probability of a cause is drawn as steps over its time spans."""

from dmrl.viewer.content.causes import EDGE_S, _build_steps


def test_probability_of_a_cause_is_zero_outside_its_spans() -> None:
    stretches = [
        {"from_s": 0.0, "to_s": 4.0, "probability": 0.5},
        {"from_s": 8.0, "to_s": 30.0, "probability": 1.0},
    ]
    at_s, values = _build_steps(stretches, 28.5)
    wanted = [(-EDGE_S, 0), (0, 0.5), (4, 0.5), (4 + EDGE_S, 0)]
    wanted += [(8 - EDGE_S, 0), (8, 1), (30, 1), (30 + EDGE_S, 0)]
    assert list(zip(at_s.tolist(), values.tolist(), strict=True)) == wanted
    at_s, values = _build_steps(stretches[:1], 28.5)
    assert (at_s[-1], values[-1]) == (28.5, 0)
