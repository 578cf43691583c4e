"""Applications, callable from Python without ROS; each command has a module of its name."""
