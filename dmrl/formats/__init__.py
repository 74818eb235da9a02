"""Foreign formats, one file each: they convert bytes to samples. Stages write the samples."""
