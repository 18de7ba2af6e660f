"""Analysis of a plan's trials."""
