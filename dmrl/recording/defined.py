"""Numbers of the channels and schemas of a recording that is written, and their records."""

from collections.abc import Mapping

from mcap.records import Channel as McapChannel
from mcap.records import Schema

from dmrl.recording.channel import Channel
from dmrl.recording.container import laid_out


class Defined:
    """Channels and schemas by number, as they are met; a copy keeps the numbers it had."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, McapChannel] = {}
        self._numbers: dict[Channel, int] = {}
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
            if channel not in self._numbers and number not in self.channels:
                self._define(channel, number, records[number].schema_id)

    def number(self, channel: Channel) -> int:
        """Number of a channel."""
        found = self._numbers.get(channel)
        return self._define(channel, _free(self.channels), None) if found is None else found

    def records(self, number: int) -> tuple[bytes, bytes]:
        """What defines a channel: the record of its schema, empty if it has none, and its own."""
        channel = self.channels[number]
        schema = self.schemas.get(channel.schema_id)
        return laid_out(schema) if schema else b"", laid_out(channel)

    def _define(self, channel: Channel, number: int, schema_number: int | None) -> int:
        metadata = dict(channel.metadata)
        schema_id = self._schema_of(channel, schema_number)
        self.channels[number] = McapChannel(
            number, channel.topic, channel.encoding, metadata, schema_id
        )
        self._numbers[channel] = number
        return number

    def _schema_of(self, channel: Channel, number: int | None) -> int:
        key = (channel.schema_name, channel.schema_encoding, channel.schema_data)
        if number == 0 or not any(key):
            return 0
        if key not in self._schema_numbers:
            if number is None or number in self.schemas:
                number = _free(self.schemas)
            self.schemas[number] = Schema(number, channel.schema_data, key[1], key[0])
            self._schema_numbers[key] = number
        return self._schema_numbers[key]


def _free(taken: Mapping[int, object]) -> int:
    """The number after the greatest, or the least that is free."""
    after = max(taken, default=0) + 1
    return after if after < 1 << 16 else next(k for k in range(1, 1 << 16) if k not in taken)
