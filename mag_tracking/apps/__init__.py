"""Applications without ROS; most commands for recordings have a module of the same name."""
