"""Measurements of hot paths: `python -m benchmarks NAME [--json FILE]`."""
