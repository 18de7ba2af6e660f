"""Evaluation plans: pre-registered, frozen and run blind."""
