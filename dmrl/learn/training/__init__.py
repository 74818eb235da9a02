"""Training: losses, optimizer, training step, validation, checkpoints and several processes."""
