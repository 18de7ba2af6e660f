"""Search of everything in the lab by a few letters of its name."""
