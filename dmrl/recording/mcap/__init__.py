"""Read and write the MCAP container: records, chunks, indexes and the summary section."""
