"""Common parts of the simulated ROS robots: message types, domains, and the robot itself."""
