"""What runs in Blender's own Python, and the protocol that both sides speak."""
