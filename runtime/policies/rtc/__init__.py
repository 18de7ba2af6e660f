"""How policy servers are told what the robot is committed to: one file per wire dialect."""
