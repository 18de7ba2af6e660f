"""LeRobot datasets in the data folder: list, view, replay, convert, merge, split, delete episodes."""
