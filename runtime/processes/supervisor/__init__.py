"""Parent of a station's processes, which starts them and restarts those that die."""
