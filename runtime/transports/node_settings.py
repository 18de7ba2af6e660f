"""Settings of the receiving half of an execution node's link."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from runtime.core.settings import Settings
from runtime.transports.node_messages import Encoding

Endpoint = Annotated[str, Field(pattern=r"^(tcp|ipc|inproc)://.+")]


class NodeSettings(Settings):
    """Publisher of a node's observations, and their reception."""

    sub_endpoint: Endpoint = "tcp://127.0.0.1:5555"
    """Where the node publishes observations."""
    encoding: Encoding = "bgr"
    """Colour order of the node's pictures; an `encoding` field on the wire wins."""
    disabled_cameras: list[str] = Field(default_factory=list)
    """Observation keys of cameras that this deployment does without."""
    detect_frozen: bool = True
    """A picture exactly like the one before counts as no newer; off for simulated cameras that may stand still."""
    stalled_after_s: float = Field(default=1.0, gt=0)
    """How long without a usable message until it is said what is missing [s]."""
    simulated: bool = False
    """The node is a simulated bench: it may be reset by us, and what it says is the truth of it is believed."""
