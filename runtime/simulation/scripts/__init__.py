"""Scripted policies of the simulated bench, and what they plan with."""
