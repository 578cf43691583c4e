"""Filters, estimators, bounds and tests: array mathematics without ROS."""
