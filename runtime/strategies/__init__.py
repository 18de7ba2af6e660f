"""One file per inference strategy. Each declares `Config`, `query` and `merge`."""
