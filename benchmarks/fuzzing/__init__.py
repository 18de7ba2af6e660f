"""Random scenarios, each determined by a seed, with checks for violations: the function `once(seed)` of each module."""
