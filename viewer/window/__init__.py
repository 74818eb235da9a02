"""Run rerun's viewer as a process: desktop window, web page, live view."""
