"""Random scenarios that are fully told by a seed, and what they find wrong: `once(seed)` of each module."""
