"""Limits of crates of other labs."""

MOST_UPLOAD = 64 * 1024**2  # [bytes] of a crate that a browser sends; the command has the next limit
MOST_BYTES = 20_000_000_000
