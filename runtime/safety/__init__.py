"""Whether an action may be sent: limits, workspace, collision, the last check."""
