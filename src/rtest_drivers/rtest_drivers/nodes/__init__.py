"""Edges of the package towards ROS."""
