"""The station's own panel: a page on its own machine with state, cameras, stop and e-stop, for when the lab is gone."""
