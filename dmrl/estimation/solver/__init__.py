"""Factors of the solver: robust losses, the table of unknowns, and measurement residuals."""
