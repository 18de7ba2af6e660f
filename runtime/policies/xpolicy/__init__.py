"""Parts of the XPolicyLab protocol: envelopes, keys of the robot's arms, observations and actions."""
