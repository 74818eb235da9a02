"""Numbers of the channels and schemas of a recording that is written, and their records."""

from collections.abc import Mapping

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel as McapChannel
from mcap.records import Schema

from dmrl.recording.block import HEAD_BYTES, Block
from dmrl.recording.channel import Channel
from dmrl.recording.chunks import RECORD_HEADER, scanned
from dmrl.recording.container import laid_out


class Defined:
    """Channels and schemas by number, as they are met; a copy keeps the numbers it had.

    ``begun`` are the channels whose definition is in a chunk.
    """

    def __init__(self) -> None:
        self.begun: set[int] = set()
        self._channels: dict[int, McapChannel] = {}
        self._schemas: dict[int, Schema] = {}
        self._begun_schemas: set[int] = {0}
        self._numbers: dict[Channel, int] = {}
        self._alike: dict[int, Channel] = {}  # seen to have the same number elsewhere
        self._schema_numbers: dict[tuple[str, str, bytes], int] = {}

    def adopt(self, channels: Mapping[int, Channel], records: Mapping[int, McapChannel]) -> None:
        """Give channels of a recording that is copied the numbers that they have there, if free.

        Parameters
        ----------
        channels
            By number.
        records
            The same, with the numbers of their schemas.
        """
        for number, channel in channels.items():
            if channel not in self._numbers and number not in self._channels:
                self._define(channel, number, records[number].schema_id)

    def number(self, channel: Channel) -> int:
        """Number of a channel."""
        found = self._numbers.get(channel)
        return self._define(channel, _free(self._channels), None) if found is None else found

    def topic(self, number: int) -> str:
        """Topic of a channel."""
        return str(self._channels[number].topic)

    def begin(self, number: int) -> bytes:
        """What is to stand before the first message of a channel; empty for those after it."""
        if number in self.begun:
            return b""
        self.begun.add(number)
        channel = self._channels[number]
        if channel.schema_id in self._begun_schemas:
            return laid_out(channel)
        self._begun_schemas.add(channel.schema_id)
        return laid_out(self._schemas[channel.schema_id], channel)

    def begin_in(self, block: Block, channels: Mapping[int, Channel]) -> bool:
        """Whether the chunk that a block is all of can stand here as it is; it counts as begun.

        Every message's channel has the same number here, and is defined before it, in the same
        words; nothing else is in the chunk.
        """
        numbers = set(block.numbers())
        if not all(self._same(number, channels[number]) for number in numbers):
            return False
        begun = set[int](), set[int]()
        if (beside := _beside(block)) is None:
            return False
        for opcode, number, record in beside:
            known = self._schemas if opcode == Opcode.SCHEMA else self._channels
            if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL) or number not in known:
                return False
            if laid_out(known[number]) != record:
                return False
            begun[opcode == Opcode.CHANNEL].add(number)
        schemas = begun[0] | self._begun_schemas
        if not numbers <= begun[1] | self.begun:
            return False
        if any(self._channels[number].schema_id not in schemas for number in begun[1]):
            return False
        self.begun |= begun[1]
        self._begun_schemas |= begun[0]
        return True

    def _same(self, number: int, channel: Channel) -> bool:
        """Whether a channel of another recording has its number here, too."""
        if self._alike.get(number) is not channel:
            if self._numbers.get(channel) != number:
                return False
            self._alike[number] = channel
        return True

    def all_begun(self) -> tuple[list[Schema], list[McapChannel]]:
        """Schemas and channels whose definition is in a chunk, by number."""
        schemas = sorted(self._begun_schemas - {0})
        return [self._schemas[n] for n in schemas], [self._channels[n] for n in sorted(self.begun)]

    def _define(self, channel: Channel, number: int, schema_number: int | None) -> int:
        schema_id = self._schema_of(channel, schema_number)
        metadata = dict(channel.metadata)
        self._channels[number] = McapChannel(
            number, channel.topic, channel.encoding, metadata, schema_id
        )
        self._numbers[channel] = number
        return number

    def _schema_of(self, channel: Channel, number: int | None) -> int:
        key = (channel.schema_name, channel.schema_encoding, channel.schema_data)
        if not any(key):
            return 0
        if key not in self._schema_numbers:
            if not number or number in self._schemas:
                number = _free(self._schemas)
            self._schemas[number] = Schema(number, channel.schema_data, key[1], key[0])
            self._schema_numbers[key] = number
        return self._schema_numbers[key]


def _beside(block: Block) -> list[tuple[int, int, bytes]] | None:
    """Opcode, number and bytes of the records of a chunk that are none of the block's messages.

    None if there are other messages, or they overlap.
    """
    first = np.append(block.start - HEAD_BYTES, len(block.data))
    last = np.concatenate([[0], block.end])
    if (first < last).any():
        return None
    found = []
    for gap in np.flatnonzero(first != last).tolist():
        scan = scanned(block.data[last[gap] : first[gap]])
        if scan.messages:
            return None
        for opcode, at, end in scan.others:
            record = scan.data[at:end].tobytes()
            number = int.from_bytes(record[RECORD_HEADER : RECORD_HEADER + 2], "little")
            found.append((opcode, number, record))
    return found


def _free(taken: Mapping[int, object]) -> int:
    """The number after the greatest, or the least that is free."""
    after = max(taken, default=0) + 1
    return after if after < 1 << 16 else next(k for k in range(1, 1 << 16) if k not in taken)
