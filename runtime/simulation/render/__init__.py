"""Pictures of the simulated bench and the robot over it, as its cameras would see them."""

from runtime.simulation.render.renderer import Renderer

__all__ = ["Renderer"]
