"""What the simulated robot's ROS nodes share: messages, domains, and the robot behind them."""
