"""The use cases, callable from Python without ROS: one module a command, with its name."""
