"""Evaluation of `dmrl label`: flights with known faults, and figures of their labels."""
