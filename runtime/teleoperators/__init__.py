"""What a person holds to drive the robot: one module per way to hear of it."""
