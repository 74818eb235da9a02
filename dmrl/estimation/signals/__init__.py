"""Preprocess sensor signals: clocks, image motion and step detection."""
