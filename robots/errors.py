"""One base for every error of the robot descriptions."""

from __future__ import annotations


class RobotError(Exception):
    """A robot's folder is absent or wrong; says which file and key, what was given, what is allowed."""
