"""The robot state as its firmware packs it."""

import pytest

from dmrl.formats.aideck.cpx_state import (
    RobotState,
    compress_quaternion,
    decompress_quaternion,
    pack_state,
    unpack_state,
)


def test_every_part_of_a_state_has_its_place_and_unit() -> None:
    level, packed = (0.0, 0.0, 0.0, 1.0), compress_quaternion((0.0, 0.0, 0.0, 1.0))
    state = RobotState(
        2**32 + 7, 8, (0.001, -0.002, 0.0034), (4, 5, 6), (7, 8, 9), level, (0.01, -0.011, 0.012)
    )
    values = (7, 1, -2, 3, 4000, 5000, 6000, 7000, 8000, 9000, packed, 10, -11, 12)
    assert pack_state(state) == values
    back = unpack_state(values, 2**32 + 7, 8)
    assert (back.robot_ms, back.received_us) == (2**32 + 7, 8)
    assert (back.position_m, back.velocity_mps) == ((0.001, -0.002, 0.003), (4, 5, 6))
    assert (back.acceleration_mps2, back.turning_radps) == ((7, 8, 9), (0.01, -0.011, 0.012))
    assert back.quaternion_xyzw == level
    assert pack_state(RobotState(0, 0, (32.766, -32.768, 99.0)))[1:4] == (32766, -32768, 32767)
    assert pack_state(RobotState(0, 0, (-99.0, 0.0006, 0.0004)))[1:4] == (-32768, 1, 0)


def test_compressed_quaternions_are_bits_of_the_firmware_s() -> None:
    half = 0.5**0.5
    assert compress_quaternion((0.0, 0.0, 0.0, 1.0)) == (3 << 30) - (1 << 32)
    assert compress_quaternion((1.0, 0.0, 0.0, 0.0)) == 0
    assert compress_quaternion((0.0, 0.0, -1.0, 0.0)) == (2 << 30 | 1 << 29 | 1 << 19 | 1 << 9) - (
        1 << 32
    )
    # The largest component is stored as positive, so that all signs are flipped.
    near = compress_quaternion((-half - 1e-9, half, 0.0, 0.0))
    assert near == 1 << 29 | 511 << 20 | 1 << 19 | 1 << 9
    assert decompress_quaternion(1 << 29 | 511 << 20) == pytest.approx((half, -half, 0, 0))
    assert decompress_quaternion(3 << 20 | 5 << 10 | 512 + 7) == pytest.approx(
        ((1 - (3**2 + 5**2 + 7**2) * 0.5 / 511**2) ** 0.5, *(n * half / 511 for n in (3, 5, -7)))
    )
