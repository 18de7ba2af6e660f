"""Preflights of checkpoints: their policy servers asked without a robot, and what was found."""
