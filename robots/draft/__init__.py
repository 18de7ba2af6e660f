"""Drafting of a robot folder from a URDF: `python -m robots new`."""

from robots.draft.drafting import DraftResult, draft_robot

__all__ = ["DraftResult", "draft_robot"]
