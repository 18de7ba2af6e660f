"""Parent of a station's processes: starts them, and starts again what dies."""
