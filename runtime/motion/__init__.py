"""Execution of actions over time: timeline, resampling and trajectories, as mathematics on arrays."""
