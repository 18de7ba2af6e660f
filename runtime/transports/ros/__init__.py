"""Common parts of both ROS transports: topics, reading of messages, alignment, commands."""
