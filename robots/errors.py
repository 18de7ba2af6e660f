"""Base of all errors of robot descriptions."""

from __future__ import annotations


class RobotError(Exception):
    """A robot's folder is missing or wrong; the message names file and key, the given value, and what is allowed."""
