"""One file per way to a robot. Each declares `Config`, `capabilities`, `source` and `sink`."""
