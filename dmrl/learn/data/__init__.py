"""Training data: batches, targets, augmentation and a torch dataset."""
