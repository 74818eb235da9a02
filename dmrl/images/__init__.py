"""Image encoding, decoding, drawing and raw Bayer images."""
