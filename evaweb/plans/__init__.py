"""Evaluations that are planned, frozen and carried out blind."""
