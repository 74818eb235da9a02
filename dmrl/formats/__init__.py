"""Foreign formats, one file each: bytes in, rows for a recording out."""
