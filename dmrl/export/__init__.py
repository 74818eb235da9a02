"""Export of recordings to files of other programs: tables, ROS 2 bags."""
