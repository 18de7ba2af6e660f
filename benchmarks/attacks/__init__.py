"""Attackers that try to delay an e-stop, each a separate program at nice 19."""
