"""Recursive estimators: the published EKF, its keyframe form and smoothers."""
