"""Applications, callable from Python without ROS. Each command has a module of the same name."""
