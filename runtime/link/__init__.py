"""Link between a station on its own computer and its lab: both its ends, and the keys of both."""
