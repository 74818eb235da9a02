"""Read and write the MCAP container: records, chunks, indexes and the summary section.

Reading: `file` opens a file, `summary_section` verifies its Summary section, `chunks.chunk_reader`
reads one chunk, and `batch_reader` iterates over all messages. `message_count` counts them, and
`extra_records` reads metadata and attachments. Files without an index are read by `record_scan`.
Writing: `chunks.chunk_writer` fills chunks and `file_writer` writes the bytes.
This package does not decode messages. Specification: https://mcap.dev/spec
"""
