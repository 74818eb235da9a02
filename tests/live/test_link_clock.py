"""Times of the drone's clock, which its camera sends with images, become host times."""

from dmrl.live.crazyflie_link import CrazyflieLink, _LinkConnection
from dmrl.live.log_blocks import LogDecoder, LogPlan
from dmrl.live.queue import SampleQueue

S = 1_000_000_000
START_NS = 1_700_000_000 * S


def test_images_of_a_drone_that_restarted_wait_for_its_new_clock() -> None:
    now = [START_NS]
    link = CrazyflieLink("cf1", "udp://127.0.0.1:1", {}, 10, SampleQueue(), lambda: now[0])
    assert link.to_host_time_ns(12_000) is None
    link._flight = _LinkConnection(LogDecoder("cf1", LogPlan((), {}, frozenset())))
    list(link._flight.add_packet("b", 12_000, {}, START_NS))
    link.health.last_arrival_ns = START_NS
    assert link.to_host_time_ns(12_000 + 50) == START_NS + S // 20
    now[0] += 4 * S  # without log packets, for example after radio loss, the clock continues
    assert link.to_host_time_ns(12_000 + 4_000) == now[0]
    assert link.to_host_time_ns(300) is None  # the drone restarted
