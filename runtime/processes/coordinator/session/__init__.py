"""State machine of a session: which command is allowed when, and what follows."""
