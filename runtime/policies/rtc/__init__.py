"""Conditioning of real-time chunking in requests to policy servers: one module per dialect."""
