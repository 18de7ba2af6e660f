"""Find anything: what there is in the lab, by a few letters of its name."""
