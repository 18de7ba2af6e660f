"""Deployment files: schema, loader, reference."""
