"""Input and output of the operator at a terminal: the parts of `python -m runtime.ctl`."""
