"""Training: losses, optimizer, train step, validation and checkpoints."""
