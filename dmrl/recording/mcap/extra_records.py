"""Read the Header, and the Metadata and Attachment records that the Summary lists, verified."""

import zlib
from io import BytesIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Header, MetadataIndex
from mcap.records import Metadata as McapMetadata
from mcap.summary import Summary as McapSummary

from dmrl.recording.mcap import checksums
from dmrl.recording.mcap.file import MAGIC, RECORD_STRUCT, BoundedReader


def read_header(stream: BoundedReader) -> Header:
    """Read the Header record: profile and library of the writer. Both are empty without one."""
    stream.seek(len(MAGIC))
    opcode, length = RECORD_STRUCT.unpack(stream.read(RECORD_STRUCT.size))
    if opcode != Opcode.HEADER:
        return Header("", "")
    header: Header = Header.read(ReadDataStream(BytesIO(stream.read(length))))
    return header


def read_metadata(stream: BoundedReader, section: McapSummary) -> dict[str, list[dict[str, str]]]:
    """Read the metadata by name, and verify them against the CRC of dmrl's recordings.

    Raises
    ------
    McapError
        If the CRC does not match, or a record is not where the Summary section lists it.
    """
    metadata: dict[str, list[dict[str, str]]] = {}
    crc = before = 0
    for place in sorted(section.metadata_indexes, key=lambda place: place.offset):
        body = _read_record(stream, place, Opcode.METADATA)
        record = McapMetadata.read(ReadDataStream(BytesIO(body[RECORD_STRUCT.size :])))
        if record.name != place.name:
            raise McapError(f"metadata {place.name} has another name")
        if record.name != checksums.METADATA_NAME or checksums.belongs_to_file(
            record.metadata, place.offset
        ):
            metadata.setdefault(record.name, []).append(dict(record.metadata))
        before, crc = crc, zlib.crc32(body, crc)
    stored = metadata.get(checksums.METADATA_NAME)
    if stored and stored[-1].get("metadata") != checksums.format_crc(before):
        raise McapError("its metadata fail their CRC")
    return metadata


def read_attachment(stream: BoundedReader, place: AttachmentIndex) -> Attachment:
    """Read an attachment with its times and media type, and verify its CRC."""
    body = _read_record(stream, place, Opcode.ATTACHMENT)[RECORD_STRUCT.size :]
    record: Attachment = Attachment.read(ReadDataStream(BytesIO(body)))
    if record.name != place.name or not has_valid_crc(record, body):
        raise McapError(f"attachment {place.name} fails its CRC")
    return record


def has_valid_crc(attachment: Attachment, body: bytes) -> bool:
    """Return whether an attachment passes its CRC, or has none.

    Parameters
    ----------
    attachment, body
        The record, and its bytes without opcode and length. Bytes may follow the CRC.
    """
    texts = attachment.name.encode(), attachment.media_type.encode()
    # Two times, two texts with their lengths, the length of the data, and the data.
    end = 8 + 8 + sum(4 + len(text) for text in texts) + 8 + len(attachment.data)
    crc = int.from_bytes(body[end : end + 4], "little")
    return crc in (0, zlib.crc32(body[:end]))


def _read_record(
    stream: BoundedReader, place: MetadataIndex | AttachmentIndex, kind: Opcode
) -> bytes:
    """Read the record that an index points at. mcap's reader would read the whole summary again."""
    stream.seek(place.offset)
    body = stream.read(place.length)
    if len(body) < RECORD_STRUCT.size or RECORD_STRUCT.unpack_from(body) != (
        kind,
        len(body) - RECORD_STRUCT.size,
    ):
        raise McapError(f"no {kind.name.lower()} at byte {place.offset}")
    return body
