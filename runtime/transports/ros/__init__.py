"""Common parts of both ROS transports: topics, message decoding, alignment in time, commands."""
