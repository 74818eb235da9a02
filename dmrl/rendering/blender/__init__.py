"""Worker code that runs in Blender's own Python, and the protocol between dmrl and the worker."""
