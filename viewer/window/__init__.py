"""The rerun viewer as a process: desktop window, web page, live view."""
