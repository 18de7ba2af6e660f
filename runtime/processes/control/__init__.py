"""Process 1, the tick: merges chunks, checks them, sends commands; no policy, no camera."""
