"""Check recordings: clocks, labels, odometry and units."""
