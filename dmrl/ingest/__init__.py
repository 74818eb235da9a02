"""Foreign files and live robots, written as recordings."""
