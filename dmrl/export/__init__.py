"""Recordings as files of other programs: tables, ROS 2 bags."""
