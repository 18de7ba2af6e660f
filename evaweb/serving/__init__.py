"""Serving of requests: listeners, limits, headers, error pages, lists and downloads."""
