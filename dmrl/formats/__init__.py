"""Foreign formats, one file each: bytes in, samples out. Stages write these; nothing here does."""
