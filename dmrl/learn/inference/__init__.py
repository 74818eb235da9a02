"""Trained models: loading, decoding, test-time augmentation, matching and metrics."""
