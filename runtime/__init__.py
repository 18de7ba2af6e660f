"""Station of a robot: control loop, inference, recording, and the bus to which clients connect."""
