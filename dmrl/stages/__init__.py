"""One file per command. No stage imports another; ``dmrl.cli`` loads them by name."""
