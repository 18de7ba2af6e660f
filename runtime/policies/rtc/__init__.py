"""The robot's commitment on the wire to policy servers: one file per dialect."""
