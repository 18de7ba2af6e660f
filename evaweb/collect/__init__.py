"""Sessions in which demonstrations are collected, with their targets, episodes and publication to a dataset."""
