"""RoboArena family of policy servers: requirements, requests, meaning of the responses."""
