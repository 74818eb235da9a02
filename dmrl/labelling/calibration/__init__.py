"""Calibration of cameras, from pictures of a chessboard or from flights."""
