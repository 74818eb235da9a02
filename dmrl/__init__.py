"""dmrl: recordings in, recordings out; teach tiny camera drones to see each other."""

__version__ = "0.1.0"
