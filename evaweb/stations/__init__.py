"""Stations: robots with their computers, leases and commands."""
