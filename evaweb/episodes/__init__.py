"""Recorded episodes: index, replay, datasets, reconcile."""
