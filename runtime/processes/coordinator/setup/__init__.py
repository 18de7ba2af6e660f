"""Set-up of a run: bench reset, homing, the policy's first action."""
