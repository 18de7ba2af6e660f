"""What both ROS transports share: which topics, what is read of messages, alignment, commands."""
