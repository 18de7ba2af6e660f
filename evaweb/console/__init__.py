"""Live page of a station: its contents, its live socket, and the web processes that serve it."""
