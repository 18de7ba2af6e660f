"""Scenes, milestones, checkpoints, trials and their scores."""
