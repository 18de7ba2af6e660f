"""Simulated robots: execution nodes of every transport, the bench with its objects, and the renderer of cameras."""
