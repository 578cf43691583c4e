"""Applications that can be called from Python without ROS.

A command that tracks, calibrates or plans has a module of the same name.
"""
