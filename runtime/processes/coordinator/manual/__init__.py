"""Manual control: joints, grippers and poses from a person."""
