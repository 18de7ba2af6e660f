"""Robots on the bench: where they are, who may command them, what was commanded."""
