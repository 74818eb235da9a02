"""Lost packets are counted by the sender's clock or counter, across pauses and restarts."""

from dataclasses import replace

import numpy as np
import pytest

from dmrl.formats.aideck.cpx import Image
from dmrl.live.camera_link import FrameCount
from dmrl.live.crazyflie_link import PacketCount

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000
BLANK = Image(4, 4, "raw", bytes(16))


def count_lost(times_ms: np.ndarray, start_ms: int = 0, period_ms: int = 10) -> int:
    """Add the packets of these times; return the number that is counted as lost."""
    packets = PacketCount()
    return sum(
        packets.add_packet("b", period_ms, (start_ms + t) % (1 << 24), START_NS + t * MS)
        for t in times_ms.tolist()
    )


@pytest.mark.parametrize("start_ms", [0, (1 << 24) - 7_000])
def test_a_pause_is_counted(start_ms: int) -> None:
    times = np.arange(0, 20_000, 10)
    kept = times[(times < 5_000) | (times >= 11_000)]
    assert count_lost(kept, start_ms) == 600
    assert count_lost(times, start_ms) == 0


def test_a_pause_longer_than_the_counter_is_counted() -> None:
    times = np.arange(0, 30_000_000, 1000)
    kept = times[(times < 5_000) | (times >= 25_000_000)]
    assert count_lost(kept, period_ms=1000) == len(times) - len(kept)


def test_lost_packets_are_counted_per_block() -> None:
    packets = PacketCount()
    lost = 0
    for t in range(0, 1000, 10):
        lost += packets.add_packet("fast", 10, t, START_NS + t * MS)
        if t % 100 == 0 and t != 500:
            lost += packets.add_packet("slow", 100, t, START_NS + t * MS)
    assert lost == 1


def test_packet_count_restarts_with_the_drone() -> None:
    packets = PacketCount()
    for t in range(60_000, 61_000, 10):
        packets.add_packet("b", 10, t, START_NS + t * MS)
    lost = [packets.add_packet("b", 10, t, START_NS + (70_000 + t) * MS) for t in (0, 10, 30)]
    assert lost == [0, 0, 1]


def test_late_packets_are_not_lost() -> None:
    """The radio may delay packets and send several at once."""
    packets = PacketCount()
    arrivals = [0, 10, 900, 900, 900, 910]
    lost = [packets.add_packet("b", 10, 10 * k, START_NS + t * MS) for k, t in enumerate(arrivals)]
    assert sum(lost) == 0


@pytest.mark.parametrize("pause", [3, 100, 300, 900])
def test_images_lost_in_a_pause_are_counted(pause: int) -> None:
    frames, rng, lost = FrameCount(), np.random.default_rng(0), 0
    for k in range(2000):
        if not 500 <= k < 500 + pause:
            image = replace(BLANK, frame_id=k % 256, time_us=100_000 * k)
            lost += frames.add_image(image, START_NS + (100 * k + int(rng.integers(30))) * MS)
    assert lost == pause


def test_image_count_restarts_with_the_camera() -> None:
    frames = FrameCount()
    ids = [(200, 9_000_000), (201, 9_100_000), (3, 10_000), (4, 110_000), (6, 310_000)]
    lost = [
        frames.add_image(replace(BLANK, frame_id=n, time_us=t), START_NS + 100 * k * MS)
        for k, (n, t) in enumerate(ids)
    ]
    assert lost == [0, 0, 0, 0, 1]
