"""Checks of an action before it is sent: limits, workspace boxes, collisions, and the command limiter."""
