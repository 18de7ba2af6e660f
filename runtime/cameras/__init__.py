"""Cameras without middleware: each comes by a source of its own and joins the observations of any transport."""
