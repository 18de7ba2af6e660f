"""Setting up a lab by sight: what is there and what is missing next, and the scene editor."""
