"""Formats of the Crazyflie: micro-SD logs, log blocks and the client's CSV files."""
