"""Asking the policy, and what its answers become."""
