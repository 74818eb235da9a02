"""ROS bags and their messages."""
