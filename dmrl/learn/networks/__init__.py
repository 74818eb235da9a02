"""Network architectures, their graph and foreign weights."""
