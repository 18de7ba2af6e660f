"""Inference: requests to the policy, and their responses."""
