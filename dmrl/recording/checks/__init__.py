"""Check recordings: clocks, labels, motion and units."""
