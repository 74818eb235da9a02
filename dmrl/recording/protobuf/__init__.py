"""Encode and decode protobuf messages as columns."""
