"""Ring buffers of the exported C are shared without overwriting rows that are still needed."""

import pytest

from dmrl.deploy.c.buffer_plan import plan_buffers
from dmrl.deploy.c.row_schedule import Step, count_ring_rows, schedule_rows, share_ring
from dmrl.deploy.int8.layers import Conv

from .graphs import quantise_untrained, quantised_network
from .networks import random_network

NETWORKS = [*map(random_network, range(12)), *map(quantised_network, range(24))]


@pytest.mark.heavy
def test_ring_buffers_never_overwrite_needed_rows() -> None:
    joined = 0
    for network in [*NETWORKS, quantise_untrained("dmrl-nano", 64, 96)]:
        planned = plan_buffers(network)
        buffers = planned.buffers
        joined += sum(b.shift > 0 for b in buffers)
        held: dict[tuple[str, int], tuple[int, int]] = {}
        for write in schedule_rows(list(planned.steps), [b.rows for b in buffers]):
            b = buffers[write.buffer]
            held[b.home, (write.row + b.shift) % b.ring] = (write.buffer, write.row)
            for k, other in enumerate(buffers):
                last = write.done[k] + (k == write.buffer)
                for row in range(write.oldest[k], last):
                    assert held[other.home, (row + other.shift) % other.ring] == (k, row)
    assert joined > 5


def build_conv(**more: int) -> Conv:
    """Return a 3x3 convolution with arbitrary weights."""
    layer = next(c for n in NETWORKS for c in n.layers if isinstance(c, Conv) and c.kernel == 3)
    fields = {name: getattr(layer, name) for name in layer.__slots__}
    return Conv(**{**fields, "stride": 1, "dilation": 1, "padding": 1, **more})


@pytest.mark.parametrize("dilation", [1, 2, 5])
def test_consecutive_convolutions_cannot_share_a_ring_buffer(
    dilation: int,
) -> None:
    spread = build_conv(dilation=dilation, padding=dilation)
    steps = [Step(f"s{k}", spread, pooled=False, sources=(k,)) for k in range(3)]
    writes = schedule_rows(steps, [20] * 4)
    assert count_ring_rows(writes, 4)[1:3] == [2 * dilation + 1] * 2
    assert share_ring([1, 2], writes) == (4 * dilation + 2, [0, 3 * dilation + 1])


def test_rows_are_scheduled_as_early_as_possible() -> None:
    writes = schedule_rows([Step("s", build_conv(stride=2), pooled=False, sources=(0,))], [6, 3])
    assert [(w.buffer, w.row) for w in writes] == [
        (0, 0), (0, 1), (1, 0), (0, 2), (0, 3), (1, 1), (0, 4), (0, 5), (1, 2),
    ]  # fmt: skip
