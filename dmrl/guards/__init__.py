"""What stands between dmrl and files of strangers or of other processes.

Names that come from files, how much a file may ask for, documents of bounded depth, and the
lock that keeps one output to one writer. Nothing here knows what dmrl does.
"""
