"""Results as RO-Crates: the report of a plan with its metadata, and crates of other labs, which are read-only."""
