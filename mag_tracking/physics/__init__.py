"""Fields, sources and motion: mathematics in arrays, without ROS."""
