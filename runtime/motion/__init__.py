"""Execution over time: timeline, resampling and trajectories, as mathematics on arrays."""
