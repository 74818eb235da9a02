"""Build Arrow datasets: rows from recordings, splits, near duplicates, exclusions and shards."""
