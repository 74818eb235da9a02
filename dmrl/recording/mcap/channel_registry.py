"""Assign channel and schema ids in a new MCAP file, and serialize their records."""

from collections.abc import Collection, Iterable, Mapping

from mcap.opcode import Opcode
from mcap.records import Channel as McapChannel
from mcap.records import Schema

from dmrl.recording.mcap.channel import Channel
from dmrl.recording.mcap.chunks.chunk import RECORD_HEADER_BYTES, ParsedChunk
from dmrl.recording.mcap.file_writer import serialize
from dmrl.recording.mcap.message_batch import MessageBatch


class ChannelRegistry:
    """Channels and schemas of a file that is being written, by id.

    Ids are assigned on first use. `adopt_channels` keeps the ids of a recording that is copied.

    Attributes
    ----------
    written
        Ids of the channels whose Channel record is in a chunk already.
    """

    def __init__(self) -> None:
        self.written: set[int] = set()
        self._channels: dict[int, McapChannel] = {}
        self._records: dict[tuple[int, int], bytes] = {}  # by opcode and id
        self._written_schemas: set[int] = {0}
        # Channels and schemas that are defined even if no message needs them.
        self._kept: set[int] = set()
        self._kept_schemas: set[int] = set()
        self._channel_ids: dict[Channel, int] = {}
        # By identity: to hash a channel takes longer than to copy its messages. The reference to
        # each channel keeps its id() valid.
        self._id_by_identity: dict[int, tuple[Channel, int]] = {}
        self._same_id_channels: dict[
            int, Channel
        ] = {}  # channels of copied files that have the same id
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}

    def adopt_channels(
        self, channels: Mapping[int, Channel], records: Mapping[int, McapChannel]
    ) -> None:
        """Assign the ids that channels have in a recording that is copied, where they are free.

        Parameters
        ----------
        channels
            By channel id.
        records
            Channel records by channel id, with the schema ids.
        """
        for number, channel in channels.items():
            if channel not in self._channel_ids and number not in self._channels:
                self._define_channel(channel, number, records[number].schema_id)

    def keep_definitions(self, channels: Iterable[Channel], schemas: Iterable[Schema]) -> None:
        """Define channels and schemas, even if no message needs them."""
        self._kept.update(self.get_channel_id(channel) for channel in channels)
        for one in schemas:
            number = self._define_schema((one.name, one.encoding, one.data), one.id)
            self._kept_schemas.add(number)

    def take_unwritten_definitions(self) -> bytes:
        """Return the records of kept definitions that are in no chunk; they count as written."""
        records = [self.definition_records(number) for number in sorted(self._kept)]
        unwritten = self._kept_schemas - self._written_schemas
        self._written_schemas |= unwritten
        records += [self._records[Opcode.SCHEMA, number] for number in sorted(unwritten)]
        return b"".join(records)

    def get_channel_id(self, channel: Channel) -> int:
        """Return the id of a channel; assign one if it has none."""
        cached = self._id_by_identity.get(id(channel))
        if cached is None:
            found = self._channel_ids.get(channel)
            number = (
                self._define_channel(channel, _find_free_id(self._channels), None)
                if found is None
                else found
            )
            cached = self._id_by_identity[id(channel)] = channel, number
        return cached[1]

    def get_topic(self, number: int) -> str:
        """Return the topic of a channel id."""
        return str(self._channels[number].topic)

    def definition_records(self, channel_id: int) -> bytes:
        """Return the records to write before the first message of a channel; empty later.

        The channel counts as written from then on.
        """
        if channel_id in self.written:
            return b""
        self.written.add(channel_id)
        schema_id = self._channels[channel_id].schema_id
        record = self._records[Opcode.CHANNEL, channel_id]
        if schema_id in self._written_schemas:
            return record
        self._written_schemas.add(schema_id)
        return self._records[Opcode.SCHEMA, schema_id] + record

    def can_copy_chunk(
        self, batch: MessageBatch, others: ParsedChunk, channels: Mapping[int, Channel]
    ) -> bool:
        """Return whether a compressed chunk can be copied as it is; if so, mark its channels.

        This requires that every channel has the same id here, that the chunk or an earlier one
        contains an identical definition, and that the chunk contains no other records. The channels
        then count as written.

        Parameters
        ----------
        batch
            All messages of the chunk.
        others
            All other records of the chunk.
        channels
            By channel id in the chunk.
        """
        numbers, alike = batch.list_channel_ids(), self._same_id_channels
        unverified = [number for number in numbers if alike.get(number) is not channels[number]]
        if not all(self._has_same_id(number, channels[number]) for number in unverified):
            return False
        written_here = set[int](), set[int]()
        for opcode, at, end in others.others:
            record = others.data[at:end].tobytes()
            number = int.from_bytes(record[RECORD_HEADER_BYTES : RECORD_HEADER_BYTES + 2], "little")
            if self._records.get((opcode, number)) != record:
                return False
            written_here[opcode == Opcode.CHANNEL].add(number)
        schemas = written_here[0] | self._written_schemas
        if not (written_here[1] | self.written).issuperset(numbers):
            return False
        if any(self._channels[number].schema_id not in schemas for number in written_here[1]):
            return False
        self.written |= written_here[1]
        self._written_schemas |= written_here[0]
        return True

    def _has_same_id(self, number: int, channel: Channel) -> bool:
        """Return whether a channel of another recording has the same id here."""
        if self._channel_ids.get(channel) != number:
            return False
        self._same_id_channels[number] = channel
        return True

    def list_written_definitions(self) -> tuple[list[bytes], list[bytes]]:
        """Return the Schema and Channel records that are in a chunk, by id."""
        schemas = [self._records[Opcode.SCHEMA, n] for n in sorted(self._written_schemas - {0})]
        return schemas, [self._records[Opcode.CHANNEL, n] for n in sorted(self.written)]

    def _define_channel(self, channel: Channel, number: int, schema_number: int | None) -> int:
        kind = channel.schema_name, channel.schema_encoding, channel.schema_data
        schema_id = self._define_schema(kind, schema_number) if any(kind) else 0
        metadata = dict(channel.metadata)
        made = McapChannel(number, channel.topic, channel.encoding, metadata, schema_id)
        self._channels[number], self._records[Opcode.CHANNEL, number] = made, serialize(made)
        self._channel_ids[channel] = number
        return number

    def _define_schema(self, key: tuple[str, str, bytes], number: int | None) -> int:
        if key not in self._schema_ids:
            taken = set(self._schema_ids.values())
            if not number or number in taken:
                number = _find_free_id(taken)
            made = Schema(number, key[2], key[1], key[0])
            self._schema_ids[key], self._records[Opcode.SCHEMA, number] = number, serialize(made)
        return self._schema_ids[key]


def _find_free_id(taken: Collection[int]) -> int:
    """Return the id after the greatest one, or the smallest that is free."""
    after = max(taken, default=0) + 1
    return after if after < 1 << 16 else next(k for k in range(1, 1 << 16) if k not in taken)
