"""Arguments, progress and printed results of commands."""
