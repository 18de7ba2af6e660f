"""Execution over time: timeline and trajectories, as mathematics on arrays."""
