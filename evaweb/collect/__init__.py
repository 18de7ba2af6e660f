"""Sessions of collecting demonstrations: what they are to yield, the episodes they have, on the way to a dataset."""
