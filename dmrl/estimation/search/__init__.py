"""Search for the modes of a pair: hypotheses, filters forwards and backwards, mirrored copies."""
