"""Simulated robots: an execution node for every transport, the bench with its objects, and the renderer of cameras."""
