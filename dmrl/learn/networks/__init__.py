"""Network architectures, the traced operation graph, and import of Keras weights."""
