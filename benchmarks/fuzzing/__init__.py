"""Random scenarios, each determined by a seed, and the violations they find: `once(seed)` of each module."""
