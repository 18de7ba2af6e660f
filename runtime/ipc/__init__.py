"""Communication of a station's processes and clients: shared state, rings, messages, the bus, the latch."""
