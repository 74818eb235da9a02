"""Calibrate camera intrinsics from chessboard images, and mount and delay from flights."""
