"""Applications that can be called from Python without ROS. The module of a command has its name."""
