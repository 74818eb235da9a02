"""Samples: a time, a topic and the fields of a message that is not built yet.

Formats, flights and renders yield them, stages write them. This package opens no file and does
not depend on recordings.
"""
