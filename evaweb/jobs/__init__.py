"""Work for the worker: rows that are claimed, done and swept."""
