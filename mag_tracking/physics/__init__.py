"""Magnetic fields, source models and motion models: array mathematics without ROS."""
