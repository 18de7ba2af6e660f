"""Simulated robots: execution nodes of every transport, the bench that they move, and what draws it."""
