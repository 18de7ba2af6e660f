"""Simulated bench: objects on a table, their motion, and the effect of fingers on them."""
