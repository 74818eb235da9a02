"""Protect against untrusted files and concurrent processes.

Checks of names from files, limits on resources, parsers of bounded depth, and locks that give
each output one writer. These modules do not depend on the rest of dmrl.
"""
