"""Devices of LeRobot (robots, teleoperators, cameras), each in a process with LeRobot's own Python environment."""
