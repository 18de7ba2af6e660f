"""Programs that command a station over the bus."""
