"""The simulated bench: what lies on the table, how it moves, and how fingers move it."""
