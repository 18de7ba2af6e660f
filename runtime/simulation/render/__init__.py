"""Renderer of the simulated bench and the robot above it, as the robot's cameras would show them."""

from runtime.simulation.render.renderer import Renderer

__all__ = ["Renderer"]
