"""Built-in robot models and their registry."""
