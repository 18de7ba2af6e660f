"""Panel of a station: a page on its own machine with state, cameras, stop and e-stop, for use without the lab."""
