"""Live view of a station in Foxglove: a bridge that can only show."""
