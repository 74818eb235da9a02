"""Decode protobuf messages to Arrow columns, and encode columns to messages."""
