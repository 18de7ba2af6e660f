"""Simulated benches as data: a folder each; `bench.toml` states what a reset can lay out and what is judged."""
