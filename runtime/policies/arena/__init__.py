"""The RoboArena family of policy servers: what one wants, what it is sent, what its answers mean."""
