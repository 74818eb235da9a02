"""Samples: a time, a topic and the fields of a message that is not built yet.

Formats, flights and renders give them, stages write them. Nothing here opens a file or knows
what a recording is.
"""
