"""Prepare sensor signals: clocks, image motion, step detection."""
