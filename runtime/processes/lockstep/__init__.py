"""Lockstep: all station processes in one, on a virtual clock."""
