"""Applications that can be called from Python without ROS.

Most commands that process recordings have a module of the same name.
"""
