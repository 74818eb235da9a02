"""What people read while a command runs: progress, tables, the ending."""
