"""Scripted policies for the simulated bench, with the detection and motion planning that they need."""
