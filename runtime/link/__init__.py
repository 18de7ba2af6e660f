"""A station on its own computer, linked to its lab: both ends of the link, and the keys of both."""
