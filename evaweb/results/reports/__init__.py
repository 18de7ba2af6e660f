"""What of a plan's results leaves the lab: documents, tables, the program that recomputes them."""
