"""Drafts a robot folder from a URDF: `python -m robots new`."""

from robots.draft.drafting import Drafted, draft

__all__ = ["Drafted", "draft"]
