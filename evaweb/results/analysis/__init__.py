"""Numbers of a plan's trials."""
