"""Scripted policies for the simulated bench, with their detection and motion planning."""
