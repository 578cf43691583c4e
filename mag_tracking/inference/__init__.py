"""Filters and tests: mathematics in arrays, without ROS."""
