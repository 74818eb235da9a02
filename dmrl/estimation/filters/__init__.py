"""Published Kalman filter of a pair."""
