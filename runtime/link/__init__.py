"""Link between a station on its own computer and its lab: both ends, and the keys of both."""
