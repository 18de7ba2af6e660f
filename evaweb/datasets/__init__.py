"""LeRobot datasets under the data folder: listed, looked at, replayed, converted, merged, split, pruned."""
