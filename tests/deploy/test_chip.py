"""Our int8 maps of two real images, compared with those that the published chip computed."""

import runpy
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "bench_chip.py"


@pytest.mark.heavy
def test_int8_maps_agree_with_the_chip_as_well_as_float(data: Path) -> None:
    found, pictures = runpy.run_path(str(BENCHMARK))["compare"](data)
    assert len(pictures) == 2
    for (name, channel, who), agreement in found.items():
        assert agreement.correlation > 0.949
        # Float sums, and hence rounded weights, differ slightly between processors.
        assert agreement.mean_steps <= 1.02 * found[name, channel, "float"].mean_steps, who
        if channel == "confidence":
            assert agreement.mean_steps <= 1.15
        else:
            assert agreement.most_levels <= 1
