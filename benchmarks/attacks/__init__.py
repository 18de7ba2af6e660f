"""Attackers in the way of an e-stop, each a program of its own at nice 19."""
