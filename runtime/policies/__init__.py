"""One file per policy protocol. Each declares `Config` and `build`."""
