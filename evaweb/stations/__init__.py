"""Robots on the bench: their sites, leases and commands."""
