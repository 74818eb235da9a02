"""Signals that stop a command set an event."""

import signal
import threading

import pytest

from dmrl.terminal.signals import set_on_signal


class SignalInDestructor:
    """Raises a signal when it is destroyed, where Python ignores exceptions."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number

    def __del__(self) -> None:
        signal.raise_signal(self.number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_amid_a_destructor_is_not_lost(number: signal.Signals) -> None:
    ended, before = threading.Event(), signal.getsignal(number)
    with set_on_signal(ended):
        assert not ended.is_set()
        SignalInDestructor(number)
        assert ended.is_set()
    assert signal.getsignal(number) is before


def test_outside_the_main_thread_signals_are_left_alone() -> None:
    before, seen = signal.getsignal(signal.SIGINT), []

    def block() -> None:
        with set_on_signal(threading.Event()):
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=block)
    thread.start()
    thread.join()
    assert seen == [before]
