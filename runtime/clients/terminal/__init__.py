"""What a person at a terminal sees and types: the parts of `python -m runtime.ctl`."""
