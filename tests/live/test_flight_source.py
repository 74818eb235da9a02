import numpy as np

from dmrl.live.simulated.flight_source import SimulatedFaults, SimulatedVariable


def test_blocks_at_the_pace_of_the_flight_send_every_value_once() -> None:
    time_s = np.arange(2000) * 0.01
    faults, variable = SimulatedFaults(), SimulatedVariable("float", (time_s, np.arange(2000.0)))
    due_s = [faults.time_at_clock(faults.boot_ms + 10 * k, 0.01 * k + 0.0037) for k in range(2000)]
    assert [variable.value_at(moment) for moment in due_s] == list(range(2000))
