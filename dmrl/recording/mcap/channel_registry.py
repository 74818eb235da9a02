"""Assign channel and schema ids in a new MCAP file, and serialize their records."""

from collections.abc import Collection, Mapping

from mcap.opcode import Opcode
from mcap.records import Channel as McapChannel
from mcap.records import Schema

from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunk import RECORD_HEADER, beside
from dmrl.recording.mcap.file_writer import laid_out
from dmrl.recording.mcap.message_batch import Block


class Defined:
    """Channels and schemas of a file that is being written, by id.

    Ids are assigned on first use. `adopt_channels` keeps the ids of a recording that is copied.

    Attributes
    ----------
    written
        Ids of the channels whose Channel record is in a chunk already.
    """

    def __init__(self) -> None:
        self.begun: set[int] = set()
        self._channels: dict[int, McapChannel] = {}
        self._records: dict[tuple[int, int], bytes] = {}  # by opcode and id
        self._begun_schemas: set[int] = {0}
        self._numbers: dict[Channel, int] = {}
        # By identity: to hash a channel takes longer than to copy its messages. The reference to
        # each channel keeps its id() valid.
        self._seen: dict[int, tuple[Channel, int]] = {}
        self._alike: dict[int, Channel] = {}  # channels of copied files that have the same id
        self._schema_numbers: dict[tuple[str, str, bytes], int] = {}

    def adopt(self, channels: Mapping[int, Channel], records: Mapping[int, McapChannel]) -> None:
        """Assign the ids that channels have in a recording that is copied, where they are free.

        Parameters
        ----------
        channels
            By channel id.
        records
            Channel records by channel id, with the schema ids.
        """
        for number, channel in channels.items():
            if channel not in self._numbers and number not in self._channels:
                self._define(channel, number, records[number].schema_id)

    def number(self, channel: Channel) -> int:
        """Return the id of a channel; assign one if it has none."""
        known = self._seen.get(id(channel))
        if known is None:
            found = self._numbers.get(channel)
            number = self._define(channel, _free(self._channels), None) if found is None else found
            known = self._seen[id(channel)] = channel, number
        return known[1]

    def topic(self, number: int) -> str:
        """Return the topic of a channel id."""
        return str(self._channels[number].topic)

    def begin(self, number: int) -> bytes:
        """Return the records to write before the first message of a channel; empty later.

        The channel counts as written from then on.
        """
        if number in self.begun:
            return b""
        self.begun.add(number)
        schema_id, record = self._channels[number].schema_id, self._records[Opcode.CHANNEL, number]
        if schema_id in self._begun_schemas:
            return record
        self._begun_schemas.add(schema_id)
        return self._records[Opcode.SCHEMA, schema_id] + record

    def begin_in(self, block: Block, channels: Mapping[int, Channel]) -> bool:
        """Return whether a compressed chunk can be copied as it is; if so, mark its channels.

        This requires that every channel has the same id here, that the chunk or an earlier one
        contains an identical definition, and that the chunk contains no other records. The channels
        then count as written.

        Parameters
        ----------
        batch
            All messages of the chunk.
        channels
            By channel id in the chunk.
        """
        numbers, alike = block.numbers(), self._alike
        fresh = [number for number in numbers if alike.get(number) is not channels[number]]
        if not all(self._same(number, channels[number]) for number in fresh):
            return False
        begun = set[int](), set[int]()
        if (found := beside(block)) is None:
            return False
        for opcode, at, end in found.others:
            record = found.data[at:end].tobytes()
            number = int.from_bytes(record[RECORD_HEADER : RECORD_HEADER + 2], "little")
            if self._records.get((opcode, number)) != record:
                return False
            begun[opcode == Opcode.CHANNEL].add(number)
        schemas = begun[0] | self._begun_schemas
        if not (begun[1] | self.begun).issuperset(numbers):
            return False
        if any(self._channels[number].schema_id not in schemas for number in begun[1]):
            return False
        self.begun |= begun[1]
        self._begun_schemas |= begun[0]
        return True

    def _same(self, number: int, channel: Channel) -> bool:
        """Return whether a channel of another recording has the same id here."""
        if self._numbers.get(channel) != number:
            return False
        self._alike[number] = channel
        return True

    def all_begun(self) -> tuple[list[bytes], list[bytes]]:
        """Return the Schema and Channel records that are in a chunk, by id."""
        schemas = [self._records[Opcode.SCHEMA, n] for n in sorted(self._begun_schemas - {0})]
        return schemas, [self._records[Opcode.CHANNEL, n] for n in sorted(self.begun)]

    def _define(self, channel: Channel, number: int, schema_number: int | None) -> int:
        schema_id = self._schema_of(channel, schema_number)
        metadata = dict(channel.metadata)
        made = McapChannel(number, channel.topic, channel.encoding, metadata, schema_id)
        self._channels[number], self._records[Opcode.CHANNEL, number] = made, laid_out(made)
        self._numbers[channel] = number
        return number

    def _schema_of(self, channel: Channel, number: int | None) -> int:
        key = (channel.schema_name, channel.schema_encoding, channel.schema_data)
        if not any(key):
            return 0
        if key not in self._schema_numbers:
            taken = set(self._schema_numbers.values())
            if not number or number in taken:
                number = _free(taken)
            made = Schema(number, channel.schema_data, key[1], key[0])
            self._schema_numbers[key], self._records[Opcode.SCHEMA, number] = number, laid_out(made)
        return self._schema_numbers[key]


def _free(taken: Collection[int]) -> int:
    """Return the id after the greatest one, or the smallest that is free."""
    after = max(taken, default=0) + 1
    return after if after < 1 << 16 else next(k for k in range(1, 1 << 16) if k not in taken)
