"""Deployment files: their schema, their loader, and the reference of their keys."""
