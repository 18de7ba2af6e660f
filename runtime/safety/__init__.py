"""Checks of an action before it is sent: limits, workspace, collision, the last check."""
