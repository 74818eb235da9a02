"""Clock of the stamps of a bag's messages: unset, simulated, wrong and restarted stamps."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice

from dmrl.errors import SourceError
from dmrl.formats.clocks import CLOCK_SET_NS, DISORDER_S, GLITCH_ROWS, NS_PER_S, UNSET_MIN_NS
from dmrl.terminal.left_out import leave_out

FIRST_MESSAGES_MAX = 1000
"""Most messages of a bag that are read to find out what its stamps of 0 mean."""


@dataclass(slots=True)
class MessageClock:
    """Clock of the stamps of messages, beside the times at which a bag received them.

    Parameters
    ----------
    source
        The bag, for errors.
    from_zero
        Topics whose stamps begin with 0, as in a simulation: there, 0 is a time.
    ahead_ns
        Receive times are ahead of simulated stamps by this much.
    """

    source: object
    from_zero: set[str] = field(default_factory=set)
    ahead_ns: int = 0
    latest_ns: dict[str, int] = field(default_factory=dict)
    before_jump_ns: dict[str, int] = field(default_factory=dict)
    behind: Counter[str] = field(default_factory=Counter)

    @classmethod
    def from_stamps(
        cls, source: object, stamps: Iterable[tuple[str, int | None, int]]
    ) -> "MessageClock":
        """Return the clock of a bag, by topic, stamp and receive time of its first messages.

        It reads to the first stamp that is not 0, and to the second message of topics that begin
        with 0, but no more than `FIRST_MESSAGES_MAX`.
        """
        clock = cls(source)
        waiting: set[str] = set()
        for topic, stamp_ns, received_ns in islice(stamps, FIRST_MESSAGES_MAX):
            if stamp_ns == 0:
                (waiting.discard if topic in waiting else waiting.add)(topic)
            elif stamp_ns:
                near = stamp_ns < UNSET_MIN_NS
                if near and topic in waiting:
                    clock.from_zero.add(topic)
                waiting.discard(topic)
                if near and received_ns - stamp_ns > CLOCK_SET_NS:
                    clock.ahead_ns = received_ns - stamp_ns
                if not waiting:
                    break
        return clock

    def find_time_ns(self, topic: str, stamp_ns: int | None, received_ns: int) -> int | None:
        """Return the time of a message; None: its stamp is wrong, and it is left out.

        Parameters
        ----------
        topic
            Its topic, whose stamps increase.
        stamp_ns
            Time in its header; None: it has none, 0: perhaps not set.
        received_ns
            Time at which the bag received it.

        Raises
        ------
        SourceError
            If the stamps of a topic start again, as after a simulation was reset.
        """
        if stamp_ns is None or self.is_unset(topic, stamp_ns):
            return max(received_ns - self.ahead_ns, 0)
        latest_ns = self.latest_ns.get(topic, stamp_ns)
        before_ns = self.before_jump_ns.pop(topic, None)
        if before_ns is not None and abs(stamp_ns - before_ns) < UNSET_MIN_NS:
            latest_ns = before_ns  # the stamp before this one was wrong, not this one
        elif stamp_ns - latest_ns > UNSET_MIN_NS:
            self.before_jump_ns[topic] = latest_ns
        if stamp_ns >= latest_ns - DISORDER_S * NS_PER_S:
            self.latest_ns[topic] = max(stamp_ns, latest_ns)
            self.behind[topic] = 0
            return stamp_ns
        self.behind[topic] += 1
        if self.behind[topic] > GLITCH_ROWS:
            raise SourceError(
                f"{self.source}: the stamps of {topic} go back from {latest_ns * 1e-9:.9g} s to "
                f"{stamp_ns * 1e-9:.9g} s, received at {received_ns * 1e-9:.9g} s: a second "
                "flight, or a simulation that was reset. Split the bag there"
            )
        leave_out("messages whose stamp jumps back", f"{self.source}: {topic}")
        return None

    def is_unset(self, topic: str, stamp_ns: int | None) -> bool:
        """Return whether a stamp of 0 means that the clock was not set."""
        return stamp_ns == 0 and topic not in self.from_zero
