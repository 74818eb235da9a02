"""Judge of `dmrl label`: flights with known faults, and the figures of what comes out."""
