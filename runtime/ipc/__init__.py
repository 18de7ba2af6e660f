"""How processes and clients of a station talk: shared state, rings, messages, the bus, the e-stop's latch."""
