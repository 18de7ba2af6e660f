"""What a plan's trials show, in numbers."""
