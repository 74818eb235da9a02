"""Training data: batches, augmentation, crops and grid targets."""
